"""``ls3 collect``: a task's offline episodes, saved to train on later."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ls3_recipes.command_settings import CollectSettings
from ls3_recipes.configuration import register, run_command
from ls3_recipes.extra import Job

HELP = """
Collect a task's offline episodes: successes, violations, and random data where the task has it.

  ls3 collect [task=NAME] [seed=N] [output=DIR] [task.offline_episodes=N]

Examples
  ls3 collect task=navigation seed=1 output=data/mine
  ls3 train data=data/mine
"""


register("collect", CollectSettings)
collect = Job("ls3 collect", "ls3_recipes.collection:collect")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    arguments = sys.argv[1:] if arguments is None else arguments
    run_command("collect", CollectSettings, collect, arguments, help_text=HELP)
