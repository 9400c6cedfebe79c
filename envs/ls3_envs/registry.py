"""One table of domains: how each is built, who demonstrates on it, and how many pictures the agent sees at once."""

from __future__ import annotations

import multiprocessing
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

from ls3_envs._checks import explain_options, nearest, parameters_of, usable_device, whole_number
from ls3_envs.base import VisualConstraintEnv
from ls3_envs.demonstrators.scripted import Scripted, collect_episodes
from ls3_envs.lazy import Lazy
from ls3_envs.seeding import checked_seed

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
        TypeError: for a number of episodes that is not whole, a policy that cannot be called or options without names.
    """

    episodes: int
    policy: Callable[..., Scripted]
    env_options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        whole_number(self.episodes, "episodes")
        _check_callable(self.policy, "policy", "the scripted policy's class, or a Lazy of it")
        _check_mapping(self.env_options, "env_options", "options of the environment by name")


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
        horizon: steps of an episode when no other number is asked for, which Gymnasium's spec says as
            ``max_episode_steps``. When ``None`` it is read from the default of the environment's own ``horizon``; a
            ``Lazy`` cannot be asked.

    Raises:
        ValueError: for an id that Gymnasium does not take, data of another name, fewer than one frame or step, or a
            stride below one step.
        TypeError: for an environment that cannot be called, and other values of another type.
    """

    env: Callable[..., VisualConstraintEnv]
    gym_id: str
    offline: Mapping[str, OfflineData] = field(default_factory=dict)
    frames: int = 1
    frame_stride: int = 1
    horizon: int | None = None

    def __post_init__(self) -> None:
        _check_callable(self.env, "env", "the environment's class, or a Lazy of it")
        if not isinstance(self.gym_id, str):
            raise TypeError(f"gym_id must be a string such as 'namespace/Name-v0', got {self.gym_id!r}.")
        if not re.fullmatch(r"([\w:-]+/)?[\w:.-]+-v\d+", self.gym_id):
            raise ValueError(f"gym_id must read 'namespace/Name-v0', got {self.gym_id!r}.")
        _check_mapping(self.offline, "offline", "OfflineData by 'success', 'rand' or 'constraint'")
        for kind, data in self.offline.items():
            if kind not in KINDS:
                raise ValueError(f"offline data must be called {', '.join(map(repr, KINDS))}, got {kind!r}.")
            if not isinstance(data, OfflineData):
                raise TypeError(f"offline[{kind!r}] must be an OfflineData, got {data!r}.")
        _check_frames(self.frames, self.frame_stride)
        if self.horizon is not None:
            whole_number(self.horizon, "horizon", unit=" step")

    def default_horizon(self) -> int | None:
        """Steps of an episode when no other number is asked for, as far as it is known without importing anything."""
        if self.horizon is not None or isinstance(self.env, Lazy):
            return self.horizon
        own = (parameters_of(self.env) or {}).get("horizon")
        if own is None or own.default is own.empty or own.default is None:
            return None
        return whole_number(own.default, f"horizon of {getattr(self.env, '__name__', self.env)!s}", unit=" step")


def _check_frames(frames: int, stride: int) -> None:
    for what, number in (("frames", frames), ("frame_stride", stride)):
        whole_number(number, what)


def _check_callable(value: object, name: str, allowed: str) -> None:
    if not callable(value):
        raise TypeError(f"{name} must be {allowed}; got {value!r}.")


def _check_mapping(value: object, name: str, allowed: str) -> None:
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise TypeError(f"{name} must be a mapping, {allowed}; got {value!r}.")


_DOMAINS: dict[str, Domain] = {}

#: All domains by name, to read; :func:`register` adds to them.
DOMAINS: Mapping[str, Domain] = MappingProxyType(_DOMAINS)


def register(name: str, row: Domain) -> None:
    """Add a domain: ``make``, ``collect_offline``, Gymnasium and every list of domains know it from then on.

    Args:
        name: of the domain, as in ``make(name)``.
        row: what there is to say about it.

    Raises:
        ValueError: for a name or a Gymnasium id that is taken, or an empty name.
        TypeError: for a name that is no string, or a row that is no :class:`Domain`.

    Example:
        >>> from ls3_envs.navigation import NavigationEnv
        >>> register("my_navigation", Domain(NavigationEnv, "me/Navigation-v0"))
        >>> make("my_navigation", 2, horizon=7).base_env.horizon
        7
        >>> unregister("my_navigation")
    """
    if not isinstance(name, str):
        raise TypeError(f"A domain's name must be a string, got {name!r}.")
    if not name:
        raise ValueError("A domain's name must not be empty: it is what make(name) is called with.")
    if not isinstance(row, Domain):
        raise TypeError(f"Domain {name!r} must be described by a Domain(env, gym_id, ...), got {row!r}.")
    if name in _DOMAINS:
        raise ValueError(f"Domain {name!r} is registered already. Choose another name, or unregister({name!r}) first.")
    if row.gym_id in gymnasium.registry:
        raise ValueError(f"Gymnasium has an environment {row.gym_id!r} already. Choose another gym_id for {name!r}.")
    gymnasium.register(
        row.gym_id,
        entry_point="ls3_envs.gym:GymEnv",
        vector_entry_point="ls3_envs.gym:GymVectorEnv",
        max_episode_steps=row.default_horizon(),
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
        horizon=100,
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
        horizon=100,
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
        horizon=150,
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
        horizon=50,
    ),
)


def domain(name: str) -> Domain:
    """The table's row for ``name``.

    Raises:
        ValueError: for an unknown domain; the message lists those there are.
        TypeError: for a name that is no string.
    """
    if not isinstance(name, str):
        raise TypeError(f"A domain's name must be a string, got {name!r}. Known domains: {', '.join(sorted(DOMAINS))}.")
    if name not in DOMAINS:
        worker = multiprocessing.parent_process() is not None
        raise ValueError(
            f"Unknown domain {name!r}. Known domains: {', '.join(sorted(DOMAINS))}.{nearest(name, DOMAINS)}"
            + (" A worker process has to register a domain of your own, too: outside of 'if __name__'." * worker)
        )
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
    _check_frames(frames, stride)
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
