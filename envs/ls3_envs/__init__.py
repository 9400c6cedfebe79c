"""Visual domains with constraints, as batched TorchRL environments and as Gymnasium environments.

The environments and demonstrators of the table (``ls3_envs.ReacherEnv``, ``ls3_envs.ReacherDemonstrator``, …) are
imported when they are first asked for: importing this package needs no MuJoCo.
"""

from typing import Any

import ls3_envs._mujoco_gl  # noqa: F401  (before TorchRL, which imports MuJoCo)
from ls3_envs.base import VisualConstraintEnv
from ls3_envs.gym import GymEnv, GymVectorEnv
from ls3_envs.lazy import Lazy
from ls3_envs.plane import Circle, Plane, Rectangle
from ls3_envs.registry import (
    DOMAINS,
    Domain,
    OfflineData,
    collect_offline,
    domain,
    lazy_classes,
    make,
    register,
    unregister,
)

__all__ = [
    "DOMAINS",
    "Circle",
    "Domain",
    "GymEnv",
    "GymVectorEnv",
    "Lazy",
    "OfflineData",
    "Plane",
    "Rectangle",
    "VisualConstraintEnv",
    "collect_offline",
    "domain",
    "make",
    "register",
    "unregister",
]


def __getattr__(name: str) -> Any:
    """The environments and demonstrators that the table of domains names."""
    classes = lazy_classes()
    if name not in classes:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return classes[name].load()


def __dir__() -> list[str]:
    return sorted({*globals(), *lazy_classes()})
