"""``ls3 train``: any algorithm, end to end."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import ls3_envs  # noqa: F401  (before TorchRL, which imports MuJoCo: whatever MUJOCO_GL says)
from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.configuration import run_command, settings_class_of
from ls3_recipes.overrides import choices_of
from ls3_recipes.protocol import run_experiment


def help_text() -> str:
    """What ``ls3 train --help`` begins with."""
    return f"""
Learn a task from images, safely.

  ls3 train [algorithm={"|".join(ALGORITHMS)}] [task={"|".join(choices_of("task"))}]
            [preset={"|".join(choices_of("preset"))}] [seed=N] [output=DIR] [KEY=VALUE ...]

Collects demonstrations (or reads data=DIR), trains offline, improves online, evaluates, and leaves a folder with
metrics, checkpoints, summary.json and pictures. With algorithm=sacfd recovery=true: SACfD+RRL.

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
    try:
        settings = settings_class_of(arguments)
    except ValueError as error:
        raise SystemExit(f"ls3 train: {error}") from None
    run_command("train", settings, run_experiment, arguments, help_text=help_text())
