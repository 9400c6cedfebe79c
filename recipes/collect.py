"""Collect a task's offline episodes and save them."""

from __future__ import annotations

from pathlib import Path

import hydra
from omegaconf import DictConfig

from common import console, episode_figures, summarise
from ls3_torchrl.data import save_episodes
from rollout import collect_demonstrations


def collect(config: DictConfig) -> Path:
    """Collect and save; returns the folder. ``config`` is that of ``conf/collect.yaml``."""
    folder = Path(config.output)
    if folder.exists():
        raise FileExistsError(f"The output folder {folder} exists already. Choose another with output=DIR.")
    datasets = collect_demonstrations(config, config.seed)
    save_episodes(datasets, folder, task=config.task.name, seed=config.seed)
    for tag, episodes in datasets.items():
        s = summarise([episode_figures(episodes)])
        console.print(
            f"{tag.name.lower():<12} {s['episodes']} episodes, success {s['success_rate']:.0%}, "
            f"violation {s['violation_rate']:.0%}, return {s['return_mean']:.1f} ± {s['return_std']:.1f}"
        )
    console.print(f"Saved in [bold]{folder}[/bold]; train on them with data={folder}")
    return folder


@hydra.main(version_base="1.3", config_path="conf", config_name="collect")
def main(config: DictConfig) -> None:
    """Entry point."""
    collect(config)


if __name__ == "__main__":
    main()
