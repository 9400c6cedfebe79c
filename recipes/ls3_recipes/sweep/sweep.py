"""Many runs of a paper's figure, or of one's own: from their settings to a report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from omegaconf import OmegaConf
from rich.table import Table

from ls3_recipes.command_settings import SweepSettings
from ls3_recipes.console import console
from ls3_recipes.extra import Job as Command
from ls3_recipes.interrupts import Interrupts
from ls3_recipes.options import as_dict
from ls3_recipes.resume import require_same_settings
from ls3_recipes.run_files import read_yaml, require_folder
from ls3_recipes.run_folder import Lock
from ls3_recipes.sweep import JobsFailedError
from ls3_recipes.sweep.index import FAILED, FINISHED, NOT_BEGUN, Index
from ls3_recipes.sweep.jobs import jobs_of
from ls3_recipes.sweep.launchers import make_launcher
from ls3_recipes.sweep.plan import planned_runs
from ls3_recipes.sweep.schedule import Schedule
from ls3_torchrl.files import save_text_atomically

write_report = Command("ls3 sweep", "ls3_recipes.report.writing:write_report")


def sweep(settings: SweepSettings, overrides: Sequence[str] = (), files: str | None = None) -> Index:
    """Carry out what is left of a sweep: nothing of what is finished, the rest of what was cut off.

    Args:
        settings: of the sweep.
        overrides: arguments of ``ls3 train`` for all runs.
        files: a user's folder of settings.

    Returns:
        What became of each job; also as ``jobs.csv`` in the folder.

    Raises:
        ValueError: for a setting that no run can have, before any begins.
        FileExistsError: while another process is at this sweep, or where runs of other settings lie in its folder.
        JobsFailedError: at the end, when jobs have failed; the others are finished.
        Interrupted: for Ctrl-C or SIGTERM, when every run has saved its state.
    """
    output = Path(settings.output)
    require_folder(output, "output")
    runs = planned_runs(settings.arms, settings.settings, overrides, folder=files)
    jobs = jobs_of(runs, output, settings.rollouts)
    for run in runs:
        if (jobs[run.name].folder / "config.yaml").is_file():
            require_same_settings(jobs[run.name].folder, as_dict(run.settings))
    _require_own(output)
    launcher = make_launcher(settings.launcher, output)
    lock = _locked(output)
    try:
        named = as_dict(settings) | {"runs": {run.name: " ".join(run.overrides) for run in runs}}
        save_text_atomically(OmegaConf.to_yaml(OmegaConf.create(named)), output / "sweep.yaml")
        index = Index(output / "jobs.csv", jobs.values())
        schedule = Schedule(
            jobs, index, launcher, output / "logs", "" if files is None else str(Path(files).absolute())
        )
        with Interrupts() as interrupts:
            try:
                schedule.carry_out(interrupts)
            except KeyboardInterrupt:
                console.print("To go on: the same command.")
                raise
        launcher.close()
        _tell(index, output)
        reported = FINISHED not in (index.states[run.name] for run in runs) or _report(output, settings.title, index)
    finally:
        lock.release()
    failed = [name for name, state in index.states.items() if state in (FAILED, NOT_BEGUN)]
    if failed:
        raise JobsFailedError(
            f"{len(failed)} of {len(jobs)} jobs failed or could not begin; what they said is in {output / 'logs'}. "
            "Remove the cause and start the sweep again: what is finished is left as it is."
        )
    if not reported:
        raise JobsFailedError("all jobs are finished, but not all of their runs could be reported; see above.")
    return index


def _require_own(output: Path) -> None:
    """Refuse a folder that holds files of a sweep's names, and no sweep."""
    there = [name for name in ("sweep.yaml", "jobs.csv", "report") if (output / name).exists()]
    path = output / "sweep.yaml"
    if (output / "config.yaml").is_file():
        raise FileExistsError(f"{output} is the folder of a run. Choose another output for a sweep.")
    if there and not (path.is_file() and {"arms", "runs", "rollouts"} <= read_yaml(path).keys()):
        raise FileExistsError(
            f"{output} holds {', '.join(there)}, and no sweep that could go on. Choose another output, so that "
            "nothing of it is overwritten."
        )


def _locked(output: Path) -> Lock:
    """The lock of a folder, which is made."""
    output.mkdir(parents=True, exist_ok=True)
    try:
        return Lock(output / "lock")
    except FileExistsError as error:
        raise JobsFailedError(str(error)) from None


def _report(output: Path, title: str, index: Index) -> bool:
    """Report all runs that lie there, of earlier calls as well; whether none had to be left out."""
    try:
        return not write_report([output / "runs"], output / "report", title, index.errors).left_out
    except Exception as error:  # whatever hinders it costs no run anything
        reason = " ".join(str(error).split())
        console.print(f"There is no report: {reason}", markup=False, soft_wrap=True)
        return False


def _tell(index: Index, output: Path) -> None:
    """How many jobs ended how, and why those failed that did."""
    counts = Counter(index.states.values())
    console.print(f"{', '.join(f'{count} {state}' for state, count in counts.items())}: {output / 'jobs.csv'}")
    if index.errors:
        table = Table("job", "error", title="What failed")
        for name, error in index.errors.items():
            table.add_row(name, error)
        console.print(table)
