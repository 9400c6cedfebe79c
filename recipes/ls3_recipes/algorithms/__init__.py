"""The algorithms that a run can train, all under one protocol: one row each."""

from ls3_recipes.algorithms.awac import AWAC
from ls3_recipes.algorithms.base import Algorithm
from ls3_recipes.algorithms.bc import BehaviourCloning
from ls3_recipes.algorithms.ls3 import LS3
from ls3_recipes.algorithms.sacfd import SACfD

#: By the names that the configuration knows them by, in the order in which reports show them.
ALGORITHMS: dict[str, type[Algorithm]] = {
    "ls3": LS3,
    "sacfd": SACfD,
    "awac": AWAC,
    "bc": BehaviourCloning,
}

__all__ = ["ALGORITHMS", "Algorithm"]
