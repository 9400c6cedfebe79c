"""A task's offline episodes, saved to train on later."""

from __future__ import annotations

from pathlib import Path

from ls3_recipes.command_settings import CollectSettings
from ls3_recipes.console import console, percent_of
from ls3_recipes.figures import episode_figures, summarise
from ls3_recipes.rollout import collect_demonstrations
from ls3_recipes.run_files import require_new
from ls3_torchrl.data import save_episodes


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
