"""``ls3 evaluate``: episodes of what a run of any algorithm has trained."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ls3_recipes.command_settings import EvaluateSettings
from ls3_recipes.configuration import errors_in_one_line, register, run_command, settings_of_run
from ls3_recipes.extra import Job
from ls3_recipes.shipped import with_shipped_agents

HELP = """
Evaluate a trained agent: a table, summary.json and a video.

  ls3 evaluate run=RUN_FOLDER [agent=FILE] [episodes=N] [seed=N] [filter=RUN_FOLDER] [planner.KEY=VALUE ...]
  ls3 evaluate agent=TASK ...  # an agent that comes with this package

Examples
  ls3 evaluate agent=navigation  # a trained agent, without training one
  ls3 evaluate run=runs/navigation episodes=100
  ls3 evaluate run=runs/navigation agent=checkpoints/agent_000.pt
  ls3 evaluate run=runs/navigation planner.num_candidates=1000
  ls3 evaluate run=runs/sacfd filter=runs/navigation  # unsafe actions are replaced: a safety filter
  ls3 evaluate run=runs/sacfd filter=navigation  # the filter being an agent that comes with this package
  ls3 evaluate run=runs/navigation policy=random filter=runs/navigation output=runs/random-but-safe
"""

register("evaluate", EvaluateSettings)
evaluate = Job("ls3 evaluate", "ls3_recipes.evaluation:evaluate")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with errors_in_one_line("ls3 evaluate"):
        arguments = with_shipped_agents("evaluate", arguments)
    run_command("evaluate", EvaluateSettings, _evaluate, arguments, help_text=HELP)


def _evaluate(settings: EvaluateSettings) -> None:
    settings_of_run(settings.run)  # a folder that holds no run is refused before anything heavy is imported
    evaluate(settings)
