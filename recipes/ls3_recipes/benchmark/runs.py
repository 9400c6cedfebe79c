"""Whole runs by phase: the recipe as a user starts it, and what its summary says of the time."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

from ls3_recipes.benchmark.tables import Section
from ls3_recipes.benchmark.workbench import Workbench
from ls3_recipes.console import console
from ls3_recipes.run_files import read_json

#: Phases under other names than the summary's.
_NAMES = {"demonstrations": "data", "vae": "VAE"}
#: What the recipe does not time: imports, building, saving.
REST = "start-up and saving"


def time_runs(work: Workbench) -> list[dict[str, Any]]:
    """Run the recipe with each preset that is asked for.

    Returns:
        For each: ``preset``, ``seconds`` in all, ``cores``, and ``phases`` with ``name``, ``seconds`` and, where it is
        known, ``utilisation`` of the cores.

    Raises:
        RuntimeError: when a run fails, with what it said last.
    """
    return [_time_run(work, preset) for preset in work.settings.runs]


def _time_run(work: Workbench, preset: str) -> dict[str, Any]:
    settings, output = work.settings, work.folder / "runs" / preset
    command = [sys.executable, "-m", "ls3_recipes", "train", f"task={settings.task}", f"preset={preset}"]
    command += [f"device={work.device}", f"output='{output}'"]
    if settings.threads:
        command.append(f"threads={settings.threads}")
    console.print(f"whole run, {preset}: {' '.join(command[3:])}", markup=False, soft_wrap=True)
    start, busy = time.perf_counter(), _cpu_seconds_of_children()
    with (work.folder / f"run-{preset}.log").open("w", encoding="utf-8") as log:
        ended = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, check=False)
    seconds, busy = time.perf_counter() - start, _cpu_seconds_of_children() - busy
    if ended.returncode:
        raise RuntimeError(
            f"The run with preset={preset} ended with code {ended.returncode}; what it said is in {log.name}."
        )
    return {"preset": preset, "task": settings.task} | by_phase(read_json(output / "summary.json"), seconds, busy)


def by_phase(summary: dict[str, Any], seconds: float, busy: float = math.nan) -> dict[str, Any]:
    """What a whole run took, phase by phase, and the rest that the recipe does not time.

    Args:
        summary: of the run.
        seconds: from its start to its end.
        busy: CPU seconds of all of its processes; NaN where they are not known.
    """
    cores, used = summary["hardware"]["cores"], summary.get("cpu_utilisation", {})
    phases: list[dict[str, Any]] = []
    for name, spent in summary["seconds"].items():
        known = {"utilisation": used[name]} if name in used else {}
        phases.append({"name": _NAMES.get(name, name), "seconds": spent, **known})
    rest = {"name": REST, "seconds": max(seconds - sum(phase["seconds"] for phase in phases), 0.0)}
    left = busy - sum(phase["seconds"] * phase.get("utilisation", math.nan) * cores for phase in phases)
    if not math.isnan(left) and rest["seconds"]:
        rest["utilisation"] = min(max(left / (rest["seconds"] * cores), 0.0), 1.0)
    return {"seconds": seconds, "cores": cores, "phases": [*phases, rest]}


def _cpu_seconds_of_children() -> float:
    """Of those that have ended; NaN where the system does not say."""
    ended = os.times()
    return ended.children_user + ended.children_system if sys.platform != "win32" else math.nan


def runs_section(run: dict[str, Any]) -> Section:
    """A line for each phase of a run."""
    whole, cores = run["seconds"], run["cores"]
    lines = []
    for phase in run["phases"]:
        used = f"{phase['utilisation']:.0%}" if "utilisation" in phase else ""
        lines.append((phase["name"], f"{phase['seconds']:.1f}", f"{phase['seconds'] / whole:.0%}", used))
    mean = _mean_utilisation(run["phases"], whole)
    lines.append(("whole run", f"{whole:.1f}", "100%", "" if math.isnan(mean) else f"{mean:.0%}"))
    columns = ("phase", "seconds", "of the run", f"of {cores} cores used")
    caption = (
        f"{run['task']}, preset {run['preset']}; cores used: CPU time of all of its processes by wall time and cores"
    )
    return Section(f"A whole run of {run['preset']}", columns, lines, caption)


def _mean_utilisation(phases: Sequence[dict[str, Any]], whole: float) -> float:
    return sum(phase["seconds"] * phase.get("utilisation", math.nan) for phase in phases) / whole
