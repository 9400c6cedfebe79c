"""One table of domains: how each is built, who demonstrates on it, and how many pictures the agent sees at once."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any

import gymnasium
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import CatFrames, Compose, InitTracker, Transform, TransformedEnv, UnaryTransform

from ls3_envs.base import VisualConstraintEnv
from ls3_envs.demonstrators.scripted import Scripted, collect_episodes
from ls3_envs.lazy import Lazy

#: Episodes that are collected side by side: more would hold too many pictures at once.
_SIDE_BY_SIDE = 100

#: The paper's names of offline data: D_success, D_rand, D_constraint.
KINDS = ("success", "rand", "constraint")


@dataclass(frozen=True)
class OfflineData:
    """One kind of offline data: how many episodes, from which policy and start.

    Args:
        episodes: how many make the data set (the paper's number), at least 1.
        policy: the scripted policy's class, or a :class:`~ls3_envs.lazy.Lazy` of it; called with ``seed``.
        env_options: options of the environment for these episodes, e.g. another start.

    Raises:
        ValueError: for fewer than one episode.
    """

    episodes: int
    policy: Callable[..., Scripted]
    env_options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ValueError(f"episodes must be at least 1, got {self.episodes}.")


@dataclass(frozen=True)
class Domain:
    """A row of the table: all that is said about a domain outside its own file.

    Args:
        env: the environment's class, or a :class:`~ls3_envs.lazy.Lazy` of it where its module imports packages that
            not everybody has; called with ``num_envs``, ``seed``, ``device`` and options.
        gym_id: its name in Gymnasium, ``"namespace/Name-v0"``.
        offline: the offline data by the paper's names ``success``, ``rand`` and ``constraint``.
        frames: pictures that are stacked into one observation, where one alone does not show velocities.
        frame_stride: steps between them; what moves less than a pixel a step is seen to move over several.

    Raises:
        ValueError: for an id that Gymnasium does not take, data of another name, fewer than one frame or a stride
            below one step.
    """

    env: Callable[..., VisualConstraintEnv]
    gym_id: str
    offline: Mapping[str, OfflineData] = field(default_factory=dict)
    frames: int = 1
    frame_stride: int = 1

    def __post_init__(self) -> None:
        if not re.fullmatch(r"([\w:-]+/)?[\w:.-]+-v\d+", self.gym_id):
            raise ValueError(f"gym_id must read 'namespace/Name-v0', got {self.gym_id!r}.")
        for kind in self.offline:
            if kind not in KINDS:
                raise ValueError(f"offline data must be called {', '.join(map(repr, KINDS))}, got {kind!r}.")
        _check_frames(self.frames, self.frame_stride)


def _check_frames(frames: int, stride: int) -> None:
    for what, number in (("frames", frames), ("frame_stride", stride)):
        if number < 1:
            raise ValueError(f"{what} must be at least 1, got {number}.")


_DOMAINS: dict[str, Domain] = {}

#: All domains by name, to read; :func:`register` adds to them.
DOMAINS: Mapping[str, Domain] = MappingProxyType(_DOMAINS)


def register(name: str, row: Domain) -> None:
    """Add a domain: ``make``, ``collect_offline``, Gymnasium and every list of domains know it from then on.

    Args:
        name: of the domain, as in ``make(name)``.
        row: what there is to say about it.

    Raises:
        ValueError: for a name or a Gymnasium id that is taken.

    Example:
        >>> from ls3_envs.navigation import NavigationEnv
        >>> register("my_navigation", Domain(NavigationEnv, "me/Navigation-v0"))
        >>> make("my_navigation", 2, horizon=7).base_env.horizon
        7
        >>> unregister("my_navigation")
    """
    if name in _DOMAINS:
        raise ValueError(f"Domain {name!r} is registered already. Choose another name, or unregister({name!r}) first.")
    if row.gym_id in gymnasium.registry:
        raise ValueError(f"Gymnasium has an environment {row.gym_id!r} already. Choose another gym_id for {name!r}.")
    gymnasium.register(
        row.gym_id,
        entry_point="ls3_envs.gym:GymEnv",
        vector_entry_point="ls3_envs.gym:GymVectorEnv",
        kwargs={"domain": name},
    )
    _DOMAINS[name] = row


def unregister(name: str) -> None:
    """Take a domain out again, its Gymnasium id included: for tests, and to define one anew in a notebook.

    Raises:
        ValueError: for an unknown domain.
    """
    del gymnasium.registry[domain(name).gym_id]
    del _DOMAINS[name]


_ANYWHERE: dict[str, Any] = {"start": "random"}

register(
    "navigation",
    Domain(
        env=Lazy("ls3_envs.navigation:NavigationEnv"),
        gym_id="ls3/Navigation-v0",
        offline={
            "success": OfflineData(50, Lazy("ls3_envs.demonstrators.navigation:NavigationDemonstrator")),
            "constraint": OfflineData(50, Lazy("ls3_envs.demonstrators.navigation:NavigationViolator"), _ANYWHERE),
        },
    ),
)
register(
    "reacher",
    Domain(
        env=Lazy("ls3_envs.reacher:ReacherEnv"),
        gym_id="ls3/Reacher-v0",
        offline={
            "success": OfflineData(50, Lazy("ls3_envs.demonstrators.reacher:ReacherDemonstrator")),
            "constraint": OfflineData(50, Lazy("ls3_envs.demonstrators.reacher:ReacherViolator"), _ANYWHERE),
            "rand": OfflineData(
                100, Lazy("ls3_envs.demonstrators.reacher:ReacherWanderer"), {"start": "random", "horizon": 20}
            ),
        },
        frames=3,
        frame_stride=4,
    ),
)
register(
    "pushing",
    Domain(
        env=Lazy("ls3_envs.pushing:SequentialPushingEnv"),
        gym_id="ls3/SequentialPushing-v0",
        offline={
            "success": OfflineData(500, Lazy("ls3_envs.demonstrators.pushing:PushingDemonstrator")),
            "constraint": OfflineData(300, Lazy("ls3_envs.demonstrators.pushing:PushingViolator"), _ANYWHERE),
        },
    ),
)
register(
    "cable_routing",
    Domain(
        env=Lazy("ls3_envs.cable_routing:CableRoutingEnv"),
        gym_id="ls3/CableRouting-v0",
        offline={
            "success": OfflineData(420, Lazy("ls3_envs.demonstrators.cable_routing:CableDemonstrator")),
            "rand": OfflineData(150, Lazy("ls3_envs.demonstrators.cable_routing:CableWanderer")),
            "constraint": OfflineData(50, Lazy("ls3_envs.demonstrators.cable_routing:CableViolator")),
        },
    ),
)


def domain(name: str) -> Domain:
    """The table's row for ``name``.

    Raises:
        ValueError: for an unknown domain; the message lists those there are.
    """
    if name not in DOMAINS:
        raise ValueError(f"Unknown domain {name!r}. Known domains: {', '.join(sorted(DOMAINS))}.")
    return DOMAINS[name]


def lazy_classes() -> dict[str, Lazy]:
    """This package's own environments and demonstrators, as far as rows name them by address, by class name."""
    parts = [part for row in DOMAINS.values() for part in (row.env, *(data.policy for data in row.offline.values()))]
    return {part.name: part for part in parts if isinstance(part, Lazy) and part.module.startswith("ls3_envs.")}


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
        ValueError: for an unknown domain, fewer than one frame or a stride below one step.
        ModuleNotFoundError: when the domain needs a package that is not installed.

    Example:
        >>> make("navigation", num_envs=3, seed=0).batch_size
        torch.Size([3])
    """
    row = domain(name)
    frames = row.frames if frames is None else frames
    stride = row.frame_stride if frame_stride is None else frame_stride
    _check_frames(frames, stride)
    return TransformedEnv(row.env(num_envs=num_envs, **options), Compose(*_stack(frames, stride), InitTracker()))


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
        parts.append(collect_episodes(env, recipe.policy(seed=own)))
    return torch.cat(parts) if len(parts) > 1 else parts[0]
