"""``ls3 calibrate``: thresholds of a trained agent that miss few violations, and how many they do miss."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ls3_recipes.command_settings import CalibrateSettings
from ls3_recipes.configuration import errors_in_one_line, register, run_command, settings_of_run
from ls3_recipes.extra import Job
from ls3_recipes.shipped import with_shipped_agents

HELP = """
Find δ_C and δ_S of a trained agent so that a share alpha of violations is missed at most (split conformal prediction):
a table, summary.json and a picture. One half of fresh violating episodes finds them, the other tests them.

  ls3 calibrate run=RUN_FOLDER [agent=FILE] [alpha=[0.05,0.1]] [episodes=N] [seed=N] [data=DIR]
  ls3 calibrate agent=TASK ...  # an agent that comes with this package

Examples
  ls3 calibrate run=runs/navigation
  ls3 calibrate run=runs/navigation agent=checkpoints/agent_000.pt output=runs/before-online-learning
  ls3 calibrate run=runs/navigation alpha=[0.01] episodes=1000
  ls3 calibrate run=runs/navigation data=data/my-violations  # episodes that the run has not learnt from
"""

register("calibrate", CalibrateSettings)
calibrate = Job("ls3 calibrate", "ls3_recipes.calibration:calibrate_run")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with errors_in_one_line("ls3 calibrate"):
        arguments = with_shipped_agents("calibrate", arguments)
    run_command("calibrate", CalibrateSettings, _calibrate, arguments, help_text=HELP)


def _calibrate(settings: CalibrateSettings) -> None:
    settings_of_run(settings.run)  # a folder that holds no run is refused before anything heavy is imported
    calibrate(settings)
