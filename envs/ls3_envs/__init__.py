"""Visual domains with constraints, as batched TorchRL environments and as Gymnasium environments."""

from ls3_envs.base import VisualConstraintEnv
from ls3_envs.cable_routing import CableRoutingEnv
from ls3_envs.demonstrators import (
    CableDemonstrator,
    CableViolator,
    CableWanderer,
    NavigationDemonstrator,
    NavigationViolator,
    PushingDemonstrator,
    PushingViolator,
    ReacherDemonstrator,
    ReacherViolator,
    ReacherWanderer,
)
from ls3_envs.gym import GymEnv, GymVectorEnv, register_gymnasium
from ls3_envs.navigation import NavigationEnv
from ls3_envs.pushing import SequentialPushingEnv
from ls3_envs.reacher import ReacherEnv
from ls3_envs.registry import DOMAINS, Domain, OfflineData, collect_offline, domain, make

__all__ = [
    "DOMAINS",
    "CableDemonstrator",
    "CableRoutingEnv",
    "CableViolator",
    "CableWanderer",
    "Domain",
    "GymEnv",
    "GymVectorEnv",
    "NavigationDemonstrator",
    "NavigationEnv",
    "NavigationViolator",
    "OfflineData",
    "PushingDemonstrator",
    "PushingViolator",
    "ReacherDemonstrator",
    "ReacherEnv",
    "ReacherViolator",
    "ReacherWanderer",
    "SequentialPushingEnv",
    "VisualConstraintEnv",
    "collect_offline",
    "domain",
    "make",
    "register_gymnasium",
]

register_gymnasium()
