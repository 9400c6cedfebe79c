"""Environments as the recipes use them, demonstrations, and episodes of a trained policy."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type
from tqdm import tqdm

import ls3_envs
from ls3_recipes.console import console
from ls3_recipes.run_settings import TaskSettings
from ls3_torchrl.data import Tag
from ls3_torchrl.trainers.progress import progress_bar


def tick(bar: tqdm) -> None:
    """Advance a bar from a forward hook, whose return value would replace the module's output."""
    bar.update()


def make_env(task: TaskSettings, num_envs: int, seed: int, device: torch.device) -> TransformedEnv:
    """The task's environment, ``num_envs`` of them side by side, with marks at the starts of episodes."""
    options = {} if task.horizon is None else {"horizon": task.horizon}
    return ls3_envs.make(task.name, num_envs=num_envs, seed=seed, device=device, **options)


def collect_demonstrations(task: TaskSettings, seed: int) -> dict[Tag, TensorDictBase]:
    """The task's offline data by tag; as many episodes as the paper, or ``task.offline_episodes`` of each."""
    kinds = ls3_envs.domain(task.name).offline
    datasets = {}
    with progress_bar(len(kinds), "Demonstrations", unit="kind") as bar:
        for i, kind in enumerate(kinds):
            episodes = ls3_envs.collect_offline(task.name, kind, episodes=task.offline_episodes, seed=seed + i)
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


def run_episodes(env: TransformedEnv, policy: TensorDictModuleBase, *, what: str) -> TensorDictBase:
    """Whole episodes ``[N, T]`` of a policy, at its best rather than exploring, side by side."""
    horizon = env.base_env.horizon
    with progress_bar(horizon, what) as bar, torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        ticking = policy.register_forward_hook(lambda *_: tick(bar))
        out = env.rollout(horizon, policy, break_when_any_done=False)
        ticking.remove()
    return whole_episodes(out.cpu())
