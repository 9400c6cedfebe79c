"""Visual domains with constraints, as batched TorchRL environments."""

from ls3_envs.base import VisualConstraintEnv
from ls3_envs.demonstrators import NavigationDemonstrator, NavigationViolator
from ls3_envs.navigation import NavigationEnv
from ls3_envs.registry import DOMAINS, Domain, OfflineData, collect_offline, domain, make

__all__ = [
    "DOMAINS",
    "Domain",
    "NavigationDemonstrator",
    "NavigationEnv",
    "NavigationViolator",
    "OfflineData",
    "VisualConstraintEnv",
    "collect_offline",
    "domain",
    "make",
]
