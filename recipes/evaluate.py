"""Evaluate what a run of any recipe has trained."""

from __future__ import annotations

from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, OmegaConf

import pictures
from common import RunFolder, choose_device, episode_figures, hardware, print_summary, summarise
from comparisons import COMPARISONS
from ls3 import LS3
from protocol import Algorithm
from rollout import make_env, run_episodes

ALGORITHMS: dict[str, type[Algorithm]] = {"ls3": LS3, **COMPARISONS}


def evaluate(config: DictConfig) -> dict:
    """Run episodes of a trained policy.

    Args:
        config: the resolved configuration of ``conf/evaluate.yaml``.

    Returns:
        What is written to ``summary.json``.
    """
    folder = Path(config.run)
    if not (folder / "config.yaml").is_file():
        raise FileNotFoundError(f"{folder} is no run folder: config.yaml is missing. Pass run=DIR of a finished run.")
    device = choose_device(config.device)
    trained = OmegaConf.load(folder / "config.yaml")
    assert isinstance(trained, DictConfig)
    name = trained.get("algorithm", "ls3")
    if name == "ls3":
        trained.planner = config.planner = OmegaConf.merge(trained.planner, config.planner)
    elif config.planner:
        raise ValueError(
            f"{folder} is a run of {name}, which has no planner: planner={dict(config.planner)} is in vain."
        )
    torch.manual_seed(config.seed)
    world = make_env(trained, config.episodes, config.seed, device)
    algorithm = ALGORITHMS[name](trained, world, device)
    algorithm.prepare(world)
    algorithm.restore(folder / config.agent)
    run = RunFolder(config.output, config)
    episodes = run_episodes(world, algorithm.policy, what="Evaluation")
    summary = {
        "algorithm": algorithm.name,
        "task": trained.task.name,
        "preset": trained.preset,
        "seed": config.seed,
        "evaluation": summarise([episode_figures(episodes)]),
        "hardware": hardware(device),
        "agent": str(folder / config.agent),
    }
    pictures.video(run.path / "evaluation.gif", episodes)
    summary["minutes"] = round(run.seconds / 60, 2)
    run.write_json("summary.json", summary)
    run.close()
    print_summary(summary, run.path)
    return summary


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def main(config: DictConfig) -> None:
    """Entry point."""
    evaluate(config)


if __name__ == "__main__":
    main()
