"""Evaluate a trained agent of a run folder."""

from __future__ import annotations

from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, OmegaConf

import pictures
from common import RunFolder, choose_device, episode_figures, hardware, print_summary, summarise
from ls3_torchrl import LS3Agent
from rollout import make_env, run_episodes


def evaluate(config: DictConfig) -> dict:
    """Run episodes of a trained agent.

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
    planner_options = OmegaConf.merge(trained.planner, config.planner)
    assert isinstance(planner_options, DictConfig)
    torch.manual_seed(config.seed)
    action_spec = make_env(trained, 1, config.seed, device).action_spec
    agent = LS3Agent.load(folder / config.agent, device=device, action_dim=action_spec.shape[-1])
    planner = agent.planner(action_spec, **{str(key): value for key, value in planner_options.items()})
    config.planner = planner_options
    run = RunFolder(config.output, config)
    episodes = run_episodes(world, planner, what="Evaluation")
    summary = {
        "task": trained.task.name,
        "preset": trained.preset,
        "seed": config.seed,
        "evaluation": summarise([episode_figures(episodes)]),
        "hardware": hardware(device),
        "agent": str(folder / config.agent),
    }
    pictures.film(run.path / "evaluation.gif", episodes)
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
