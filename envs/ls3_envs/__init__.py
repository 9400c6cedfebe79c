"""Visual domains with constraints, as batched TorchRL environments and as Gymnasium environments.

Everything but the table of domains is imported when it is first asked for, the environments and demonstrators of the
table (``ls3_envs.ReacherEnv``, ``ls3_envs.ReacherDemonstrator``, …) among it: importing this package needs neither
PyTorch nor MuJoCo.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import ls3_envs._mujoco_gl  # noqa: F401  (before TorchRL, which imports MuJoCo)
from ls3_envs.lazy import Lazy
from ls3_envs.registry import DOMAINS, Domain, OfflineData, domain, lazy_classes, register, unregister

if TYPE_CHECKING:
    from ls3_envs.base import VisualConstraintEnv
    from ls3_envs.gym import GymEnv, GymVectorEnv
    from ls3_envs.making import collect_offline, make
    from ls3_envs.plane import Circle, Plane, Rectangle

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

_HOMES = {
    "base": ("VisualConstraintEnv",),
    "gym": ("GymEnv", "GymVectorEnv"),
    "making": ("collect_offline", "make"),
    "plane": ("Circle", "Plane", "Rectangle"),
    "demonstrators": (),
    "seeding": (),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """What is imported when it is asked for; classes that the table of domains names are looked up there."""
    if name in _HOMES:
        return import_module(f"{__name__}.{name}")
    if name in _HOME_OF:
        return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    classes = lazy_classes()
    if name not in classes:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return classes[name].load()


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES, *_HOME_OF, *lazy_classes()})
