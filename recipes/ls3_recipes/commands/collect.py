"""``ls3 collect``: a task's offline episodes, saved to train on later."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import ls3_envs  # noqa: F401  (before TorchRL, which imports MuJoCo: whatever MUJOCO_GL says)
from ls3_recipes.configuration import register, run_command
from ls3_recipes.console import console, percent_of
from ls3_recipes.figures import episode_figures, summarise
from ls3_recipes.rollout import collect_demonstrations
from ls3_recipes.run_files import require_new
from ls3_recipes.run_settings import TaskSettings, require_path, require_seed
from ls3_torchrl.data import save_episodes

HELP = """
Collect a task's offline episodes: successes, violations, and random data where the task has it.

  ls3 collect [task=NAME] [seed=N] [output=DIR] [task.offline_episodes=N]

Examples
  ls3 collect task=navigation seed=1 output=data/mine
  ls3 train data=data/mine
"""


@dataclass(frozen=True, kw_only=True)
class CollectSettings:
    """What is collected, and where it goes.

    Args:
        task: whose episodes.
        seed: of environments and demonstrators.
        output: a folder that does not exist yet.
    """

    task: TaskSettings
    seed: int = 0
    output: str

    def __post_init__(self) -> None:
        """Refuse what cannot be collected."""
        require_seed(self.seed)
        require_path(self.output, "output")
        if self.task.horizon is not None:
            raise ValueError(
                f"task.horizon matters to ls3 train alone, got {self.task.horizon}: offline episodes have the domain's "
                "own length. Leave it out."
            )


register("collect", CollectSettings)


def collect(settings: CollectSettings) -> Path:
    """Collect and save; returns the folder.

    Raises:
        FileExistsError: when the folder exists.
    """
    folder = require_new(settings.output)
    datasets = collect_demonstrations(settings.task, settings.seed)
    save_episodes(datasets, folder, task=settings.task.name, seed=settings.seed)
    for tag, episodes in datasets.items():
        figures = summarise([episode_figures(episodes)])
        success, violation, returns = percent_of(figures)
        console.print(
            f"{tag.name.lower():<12} {figures['episodes']} episodes, success {success}, violation {violation}, "
            f"return {returns}"
        )
    console.print(f"Saved in {folder}; train on them with data={folder}", markup=False)
    return folder


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    arguments = sys.argv[1:] if arguments is None else arguments
    run_command("collect", CollectSettings, collect, arguments, help_text=HELP)
