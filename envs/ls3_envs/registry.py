"""One table of domains: how each is built, who demonstrates on it, and how many pictures the agent sees at once.

It is read by help texts and checks of settings, and needs no PyTorch.
"""

from __future__ import annotations

import multiprocessing
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import gymnasium

from ls3_envs._checks import nearest, parameters_of, whole_number
from ls3_envs.lazy import Lazy

if TYPE_CHECKING:  # the table names what it is about, and imports none of it
    from ls3_envs.base import VisualConstraintEnv
    from ls3_envs.demonstrators.scripted import Scripted

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
        check_frames(self.frames, self.frame_stride)
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


def check_frames(frames: int, stride: int) -> None:
    """Raise ``ValueError`` for fewer than one frame, or a stride below one step."""
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
        >>> from ls3_envs import NavigationEnv, make
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
