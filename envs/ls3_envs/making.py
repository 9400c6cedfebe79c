"""Environments and offline data of the domains in the table."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import CatFrames, Compose, InitTracker, Transform, TransformedEnv, UnaryTransform

from ls3_envs._checks import explain_options, whole_number
from ls3_envs._devices import usable_device
from ls3_envs.demonstrators.scripted import collect_episodes
from ls3_envs.lazy import Lazy
from ls3_envs.registry import check_frames, domain
from ls3_envs.seeding import checked_seed

#: Episodes that are collected side by side: more would hold too many pictures at once.
_SIDE_BY_SIDE = 100


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
    """The domain ``name`` with ``num_envs`` environments, marks at the starts of episodes, and frames stacked.

    Args:
        name: of the domain.
        num_envs: N.
        frames: pictures stacked along the channels into ``pixels``, the newest last; the domain's number when ``None``.
        frame_stride: steps between them; the domain's when ``None``. Before there are as many, the first one repeats.
        options: of the environment; see its class.

    Raises:
        ValueError: for an unknown domain, fewer than one frame or a stride below one step, and as the domain does.
        TypeError: for an option that the environment does not have; the message lists those there are.
        ModuleNotFoundError: when the domain needs a package that is not installed.

    Example:
        >>> make("navigation", num_envs=3, seed=0).batch_size
        torch.Size([3])
    """
    row = domain(name)
    frames = row.frames if frames is None else frames
    stride = row.frame_stride if frame_stride is None else frame_stride
    check_frames(frames, stride)
    build = row.env.load() if isinstance(row.env, Lazy) else row.env
    try:
        env = build(num_envs=num_envs, **options)
    except TypeError as error:
        explain_options(error, build, options)
        raise
    return TransformedEnv(env, Compose(*_stack(frames, stride), InitTracker()))


def collect_offline(
    name: str, kind: str, *, episodes: int | None = None, seed: int = 0, device: torch.device | str = "cpu"
) -> TensorDictBase:
    """The offline episodes of one kind, all collected side by side.

    Args:
        name: the domain.
        kind: ``"success"``, ``"rand"`` or ``"constraint"``, as far as the domain has it.
        episodes: how many; the paper's number when ``None``.
        seed: seed of environments and demonstrator.
        device: where to simulate.

    Returns:
        Episodes ``[N, T]``.

    Raises:
        ValueError: when the domain has no such data, for fewer than one episode, a negative seed or a device that is
            not there.
        TypeError: for a number of episodes or a seed that is not whole.

    Example:
        >>> collect_offline("navigation", "success", episodes=2).batch_size
        torch.Size([2, 100])
    """
    kinds = domain(name).offline
    if kind not in kinds:
        raise ValueError(f"Domain {name!r} has no offline data {kind!r}; it has: {', '.join(sorted(kinds))}.")
    recipe = kinds[kind]
    count = recipe.episodes if episodes is None else whole_number(episodes, "episodes")
    seed, device = checked_seed(seed), usable_device(device)
    parts = []
    for first in range(0, count, _SIDE_BY_SIDE):
        part = min(_SIDE_BY_SIDE, count - first)
        # Streams of their own; those of the first part do not depend on how many parts there are.
        own = seed + 7_919 * first
        env = make(name, num_envs=part, seed=own, device=device, **recipe.env_options)
        parts.append(collect_episodes(env, recipe.policy(seed=own)))
    return torch.cat(parts) if len(parts) > 1 else parts[0]
