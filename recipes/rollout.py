"""Environments as the recipes use them, demonstrations, and episodes of a trained agent."""

from __future__ import annotations

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

import ls3_envs
from common import console, progress, tick
from ls3_torchrl.data import Tag
from ls3_torchrl.planners import LS3Planner


def make_env(config: DictConfig, worlds: int, seed: int, device: torch.device) -> TransformedEnv:
    """The task's environment with ``worlds`` worlds and marks at the starts of episodes."""
    options = {"horizon": config.task.horizon} if "horizon" in config.task else {}
    return ls3_envs.make(config.task.name, num_worlds=worlds, seed=seed, device=device, **options)


def collect_demonstrations(config: DictConfig, seed: int) -> dict[Tag, TensorDictBase]:
    """The task's offline data by tag; as many episodes as the paper, or ``task.offline_episodes`` of each."""
    kinds = ls3_envs.domain(config.task.name).offline
    datasets = {}
    with progress(len(kinds), "Demonstrations", "kind") as bar:
        for i, kind in enumerate(kinds):
            episodes = ls3_envs.collect_offline(
                config.task.name, kind, episodes=config.task.get("offline_episodes"), seed=seed + i
            )
            datasets[Tag.parse(kind)] = whole_episodes(episodes)
            bar.update()
    return datasets


def whole_episodes(episodes: TensorDictBase) -> TensorDictBase:
    """Those of ``[N, T]`` in which the physics did not blow up: what follows that is another episode."""
    broken = episodes.get(("next", "physics_error"), None)
    if broken is None or not broken.any():
        return episodes
    sound = ~broken.flatten(1).any(1)
    console.print(f"[bold red]{int((~sound).sum())} episodes were left out[/bold red]: their physics blew up.")
    if not sound.any():
        raise RuntimeError("The physics blew up in every episode. Lower the task's actions or time step.")
    return episodes[sound]


def run_episodes(
    config: DictConfig,
    planner: LS3Planner,
    episodes: int,
    seed: int,
    device: torch.device,
    *,
    what: str,
) -> TensorDictBase:
    """Whole episodes ``[N, T]`` of the agent, side by side in as many worlds."""
    env = make_env(config, episodes, seed, device)
    env.append_transform(planner.primer())
    horizon = env.base_env.horizon
    with progress(horizon, what) as bar, torch.no_grad():
        ticking = planner.register_forward_hook(lambda *_: tick(bar))
        out = env.rollout(horizon, planner, break_when_any_done=False)
        ticking.remove()
    return whole_episodes(out.cpu())
