"""Scripted policies that make the offline data: D_success, D_rand and D_constraint of section 1.3."""

from ls3_envs.demonstrators.scripted import Scripted, collect_episodes

__all__ = ["Scripted", "collect_episodes"]
