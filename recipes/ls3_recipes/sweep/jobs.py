"""The jobs of a sweep: demonstrations and VAEs, which runs share; the runs; and rollouts of their agents."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from ls3_recipes.options import as_dict
from ls3_recipes.rollout_files import agents_left
from ls3_recipes.run_files import is_finished
from ls3_recipes.run_settings import RunSettings
from ls3_recipes.sweep.plan import PlannedRun
from ls3_torchrl.options.buffer import BufferOptions

Kind = Literal["data", "vae", "train", "rollouts"]


@dataclass(frozen=True)
class Job:
    """What one process does.

    Args:
        name: in the index and of its log.
        kind: data, VAE, run or rollouts.
        folder: that it writes to.
        arguments: of ``ls3 train``; for rollouts, the number of episodes.
        needs: names of the jobs whose results it reads.
    """

    name: str
    kind: Kind
    folder: Path
    arguments: tuple[str, ...]
    needs: tuple[str, ...] = ()

    def is_done(self) -> bool:
        """Whether nothing of it is left."""
        if self.kind == "data":
            return self.folder.is_dir()
        if self.kind == "rollouts":
            there = any((self.folder / "rollouts").glob("agent_*.json"))
            return is_finished(self.folder) and there and not any(agents_left(self.folder, int(self.arguments[0])))
        return is_finished(self.folder) and (self.folder / "config.yaml").is_file()


def jobs_of(runs: Iterable[PlannedRun], output: Path, rollouts: int) -> dict[str, Job]:
    """The jobs of all runs by name, each after those that it needs.

    Args:
        runs: of the sweep.
        output: its folder.
        rollouts: episodes of the agent of each update; 0 for none.
    """
    jobs: dict[str, Job] = {}
    for run in runs:
        own, needs, arguments = run.settings, [], [*run.overrides]
        if own.data is None:
            data = _data(run, output)
            jobs.setdefault(data.name, data)
            needs.append(data.name)
            arguments.append(f"data={_quoted(data.folder)}")
        if own.vae.checkpoint is None and "vae" not in own.unread:
            vae = _vae(run, output, tuple(arguments), tuple(needs))
            jobs.setdefault(vae.name, vae)
            needs.append(vae.name)
            arguments.append(f"vae.checkpoint={_quoted(vae.folder / 'vae.pt')}")
        jobs[run.name] = Job(run.name, "train", output / "runs" / run.name, tuple(arguments), tuple(needs))
        if rollouts:
            name = f"{run.name}-rollouts"
            jobs[name] = Job(name, "rollouts", jobs[run.name].folder, (str(rollouts),), (run.name,))
    return jobs


def _data(run: PlannedRun, output: Path) -> Job:
    task, seed = run.settings.task, run.settings.seed
    name = f"data-{_shared_name(run.settings, {'task': as_dict(task), 'seed': seed})}"
    return Job(name, "data", output / "shared" / name, run.overrides)


def _vae(run: PlannedRun, output: Path, arguments: tuple[str, ...], needs: tuple[str, ...]) -> Job:
    name = f"vae-{_shared_name(run.settings, vae_depends_on(run.settings))}"
    return Job(name, "vae", output / "shared" / name, arguments, needs)


def vae_depends_on(settings: RunSettings) -> dict[str, Any]:
    """All that a trained VAE depends on: runs that differ in none of it have the same one, whatever their algorithm."""
    named = as_dict(settings)
    buffer = {field.name: named["buffer"][field.name] for field in fields(BufferOptions)}
    return {"buffer": buffer} | {name: named[name] for name in ("task", "seed", "data", "device", "agent", "vae")}


def _shared_name(settings: RunSettings, depends_on: dict[str, Any]) -> str:
    """Who shares it, for people and without doubt."""
    digest = hashlib.sha256(json.dumps(depends_on, sort_keys=True).encode()).hexdigest()[:8]
    return f"{settings.task.name}-seed{settings.seed}-{digest}"


def _quoted(path: Path) -> str:
    """A path as Hydra reads it, whatever characters it has."""
    escaped = str(path.absolute()).replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"
