"""One table of domains: how each is built, who demonstrates on it, and how many pictures the agent sees at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import CatFrames, Compose, InitTracker, Transform, TransformedEnv, UnaryTransform

from ls3_envs import demonstrators as by
from ls3_envs.base import VisualConstraintEnv
from ls3_envs.cable_routing import CableRoutingEnv
from ls3_envs.navigation import NavigationEnv
from ls3_envs.pushing import SequentialPushingEnv
from ls3_envs.reacher import ReacherEnv

#: Episodes that are collected side by side: more would hold too many pictures at once.
_SIDE_BY_SIDE = 100


@dataclass(frozen=True)
class OfflineData:
    """One kind of offline data: how many episodes (the paper's number), from which policy and start."""

    episodes: int
    policy: Callable[..., by.Scripted]
    env_options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Domain:
    """A row of the table.

    Args:
        env: the environment's class; called with ``num_envs``, ``seed``, ``device`` and options.
        offline: the offline data by the paper's names ``success``, ``rand`` and ``constraint``.
        frames: pictures that are stacked into one observation, where one alone does not show velocities.
        frame_stride: steps between them; what moves less than a pixel a step is seen to move over several.
    """

    env: Callable[..., VisualConstraintEnv]
    offline: dict[str, OfflineData]
    frames: int = 1
    frame_stride: int = 1


_ANYWHERE: dict[str, Any] = {"start": "random"}

DOMAINS: dict[str, Domain] = {
    "navigation": Domain(
        env=NavigationEnv,
        offline={
            "success": OfflineData(50, by.NavigationDemonstrator),
            "constraint": OfflineData(50, by.NavigationViolator, _ANYWHERE),
        },
    ),
    "reacher": Domain(
        env=ReacherEnv,
        offline={
            "success": OfflineData(50, by.ReacherDemonstrator),
            "constraint": OfflineData(50, by.ReacherViolator, _ANYWHERE),
            "rand": OfflineData(100, by.ReacherWanderer, {"start": "random", "horizon": 20}),
        },
        frames=3,
        frame_stride=4,
    ),
    "pushing": Domain(
        env=SequentialPushingEnv,
        offline={
            "success": OfflineData(500, by.PushingDemonstrator),
            "constraint": OfflineData(300, by.PushingViolator, _ANYWHERE),
        },
    ),
    "cable_routing": Domain(
        env=CableRoutingEnv,
        offline={
            "success": OfflineData(420, by.CableDemonstrator),
            "rand": OfflineData(150, by.CableWanderer),
            "constraint": OfflineData(50, by.CableViolator),
        },
    ),
}


def domain(name: str) -> Domain:
    """The table's row for ``name``.

    Raises:
        ValueError: for an unknown domain; the message lists those there are.
    """
    if name not in DOMAINS:
        raise ValueError(f"Unknown domain {name!r}. Known domains: {', '.join(sorted(DOMAINS))}.")
    return DOMAINS[name]


def _every(pixels: Tensor, stride: int) -> Tensor:
    """Every ``stride``-th of the pictures stacked in ``[*B, 3 k, S, S]``, the newest among them."""
    return pixels.unflatten(-3, (-1, 3))[..., ::stride, :, :, :].flatten(-4, -3)


def _stack(frames: int, stride: int) -> list[Transform]:
    if frames == 1:
        return []
    stack: list[Transform] = [CatFrames((frames - 1) * stride + 1, dim=-3, in_keys=["pixels"])]
    if stride > 1:
        stack.append(UnaryTransform(in_keys=["pixels"], out_keys=["pixels"], fn=partial(_every, stride=stride)))
    return stack


def make(
    name: str, num_envs: int = 1, *, frames: int | None = None, frame_stride: int | None = None, **options: Any
) -> TransformedEnv:
    """The domain ``name`` with ``num_envs`` worlds, marks at the starts of episodes, and frames stacked.

    Args:
        name: of the domain.
        num_envs: N.
        frames: pictures stacked along the channels into ``pixels``, the newest last; the domain's number when ``None``.
        frame_stride: steps between them; the domain's when ``None``. Before there are as many, the first one repeats.
        options: of the environment; see its class.

    Raises:
        ValueError: for an unknown domain, fewer than one frame or a stride below one step.

    Example:
        >>> make("navigation", num_envs=3, seed=0).batch_size
        torch.Size([3])
    """
    row = domain(name)
    frames = row.frames if frames is None else frames
    stride = row.frame_stride if frame_stride is None else frame_stride
    for what, number in (("frames", frames), ("frame_stride", stride)):
        if number < 1:
            raise ValueError(f"{what} must be at least 1, got {number}.")
    return TransformedEnv(row.env(num_envs=num_envs, **options), Compose(*_stack(frames, stride), InitTracker()))


def collect_offline(
    name: str, kind: str, *, episodes: int | None = None, seed: int = 0, device: torch.device | str = "cpu"
) -> TensorDictBase:
    """The offline episodes of one kind, all collected side by side.

    Args:
        name: the domain.
        kind: ``"success"``, ``"rand"`` or ``"constraint"``, as far as the domain has it.
        episodes: how many; the paper's number when ``None``.
        seed: seed of worlds and demonstrator.
        device: where to simulate.

    Returns:
        Episodes ``[N, T]``.

    Raises:
        ValueError: when the domain has no such data or fewer than one episode is asked for.

    Example:
        >>> collect_offline("navigation", "success", episodes=2).batch_size
        torch.Size([2, 100])
    """
    kinds = domain(name).offline
    if kind not in kinds:
        raise ValueError(f"Domain {name!r} has no offline data {kind!r}; it has: {', '.join(sorted(kinds))}.")
    recipe = kinds[kind]
    count = recipe.episodes if episodes is None else episodes
    if count < 1:
        raise ValueError(f"episodes must be at least 1, got {count}.")
    parts = []
    for first in range(0, count, _SIDE_BY_SIDE):
        part = min(_SIDE_BY_SIDE, count - first)
        # Streams of their own; those of the first part do not depend on how many parts there are.
        own = seed + 7_919 * first
        env = make(name, num_envs=part, seed=own, device=device, **recipe.env_options)
        parts.append(by.collect_episodes(env, recipe.policy(seed=own)))
    return torch.cat(parts) if len(parts) > 1 else parts[0]
