"""Scripted policies that make the offline data: D_success, D_rand and D_constraint of section 1.3."""

from ls3_envs.demonstrators.cable_routing import CableDemonstrator, CableViolator, CableWanderer
from ls3_envs.demonstrators.navigation import NavigationDemonstrator, NavigationViolator
from ls3_envs.demonstrators.pushing import PushingDemonstrator, PushingViolator
from ls3_envs.demonstrators.reacher import ReacherDemonstrator, ReacherViolator, ReacherWanderer
from ls3_envs.demonstrators.scripted import Scripted, collect_episodes

__all__ = [
    "CableDemonstrator",
    "CableViolator",
    "CableWanderer",
    "NavigationDemonstrator",
    "NavigationViolator",
    "PushingDemonstrator",
    "PushingViolator",
    "ReacherDemonstrator",
    "ReacherViolator",
    "ReacherWanderer",
    "Scripted",
    "collect_episodes",
]
