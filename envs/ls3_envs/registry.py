"""One table of domains: how each is built and who demonstrates on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from tensordict import TensorDictBase
from torchrl.envs import InitTracker, TransformedEnv

from ls3_envs.base import VisualConstraintEnv
from ls3_envs.demonstrators import NavigationDemonstrator, NavigationViolator, _Scripted, collect_episodes
from ls3_envs.navigation import NavigationEnv


@dataclass(frozen=True)
class OfflineData:
    """One kind of offline data: how many episodes (the paper's number), from which policy and start."""

    episodes: int
    policy: Callable[..., _Scripted]
    env_options: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Domain:
    """A row of the table.

    Args:
        env: the environment's class; called with ``num_worlds``, ``seed``, ``device`` and options.
        offline: the offline data by the paper's names ``success``, ``rand`` and ``constraint``.
    """

    env: Callable[..., VisualConstraintEnv]
    offline: dict[str, OfflineData]


DOMAINS: dict[str, Domain] = {
    "navigation": Domain(
        env=NavigationEnv,
        offline={
            "success": OfflineData(50, NavigationDemonstrator),
            "constraint": OfflineData(50, NavigationViolator, {"start": "random"}),
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


def make(name: str, num_worlds: int = 1, **options: object) -> VisualConstraintEnv:
    """The domain ``name`` with ``num_worlds`` worlds.

    Example:
        >>> make("navigation", num_worlds=3, seed=0).batch_size
        torch.Size([3])
    """
    return domain(name).env(num_worlds=num_worlds, **options)


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
    env = make(name, num_worlds=count, seed=seed, device=device, **recipe.env_options)
    return collect_episodes(TransformedEnv(env, InitTracker()), recipe.policy(seed=seed))
