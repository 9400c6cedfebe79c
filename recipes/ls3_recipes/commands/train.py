"""``ls3 train``: any algorithm, end to end."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import get_type_hints

import yaml

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.configuration import errors_in_one_line, run_command, settings_class_of, settings_of_run
from ls3_recipes.console import command_line, console
from ls3_recipes.extra import Job
from ls3_recipes.overrides import choices_of
from ls3_recipes.run_files import is_finished
from ls3_recipes.run_settings import CHANGEABLE, RunSettings
from ls3_recipes.typed import typed

run_experiment = Job("ls3 train", "ls3_recipes.protocol:run_experiment")


def help_text() -> str:
    """What ``ls3 train --help`` begins with."""
    return f"""
Learn a task from images, safely.

  ls3 train [algorithm={"|".join(ALGORITHMS)}] [task={"|".join(choices_of("task"))}]
            [preset={"|".join(choices_of("preset"))}] [seed=N] [output=DIR] [KEY=VALUE ...]
  ls3 train resume=DIR

Collects demonstrations (or reads data=DIR), trains offline, improves online, evaluates, and leaves a folder with
metrics, checkpoints, summary.json and pictures. With algorithm=sacfd recovery=true: SACfD+RRL.

A run that was cut off goes on, to the same result as one that was not: with the same command, or with resume=DIR, to
which {", ".join(CHANGEABLE)} may be added, where things lie elsewhere now.

Presets: cpu (minutes on two cores), paper (Table 1 to the letter), smoke (does everything run?)

Examples
  ls3 train task=navigation preset=cpu seed=3
  ls3 train planner.num_candidates=500 online.updates=10 output=runs/more-candidates
  ls3 train algorithm=awac policy.temperature=0.5 --help
"""


def main(arguments: Sequence[str] | None = None, *, algorithm: str | None = None) -> None:
    """Entry point.

    Args:
        arguments: of the command line; those of the process when ``None``.
        algorithm: what is trained, for the doors that are named after one.
    """
    arguments = [*(sys.argv[1:] if arguments is None else arguments)]
    if algorithm is not None:
        arguments.insert(0, f"algorithm={algorithm}")
    resumed = [argument for argument in arguments if argument.startswith("resume=")]
    if resumed:
        with command_line("ls3 train"), errors_in_one_line("ls3 train"):
            resume(resumed[-1].partition("=")[2], [argument for argument in arguments if argument not in resumed])
        return
    try:
        settings = settings_class_of(arguments)
    except ValueError as error:
        raise SystemExit(f"ls3 train: {error}") from None
    run_command("train", settings, run_experiment, arguments, help_text=help_text())


def resume(folder: str, others: Sequence[str] = ()) -> dict:
    """Go on with a run that was cut off.

    Args:
        folder: of the run.
        others: other arguments of the command line: where things lie now, such as ``data=DIR``.

    Raises:
        ValueError: for other arguments than these.
        FileNotFoundError: for a folder that holds no run.
        FileExistsError: for a run that another process is at.
    """
    if not folder:
        raise ValueError("resume needs the folder of a run: resume=DIR.")
    given = dict(other.split("=", 1) for other in others if "=" in other)
    if len(given) < len(others) or not set(given) <= set(CHANGEABLE):
        raise ValueError(
            f"resume={folder} goes on with the settings of that run; only {', '.join(CHANGEABLE)} may be given anew, "
            f"got {', '.join(others)}."
        )
    trained = settings_of_run(folder)
    if is_finished(folder):
        console.print(f"The run in {folder} is finished: nothing is left to do.", markup=False)
        return {}
    hints = get_type_hints(RunSettings)
    values = {name: typed(yaml.safe_load(value), hints[name], name) for name, value in given.items()}
    return run_experiment(replace(trained, output=folder, **values))
