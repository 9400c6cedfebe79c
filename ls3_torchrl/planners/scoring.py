"""What a plan is worth and whether it may be carried out, kept apart."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

ConstraintReduction = Literal["max", "mean"]
GoalReduction = Literal["count", "expected"]
SafeSetReduction = Literal["mean", "min"]


class PlanStatistics(NamedTuple):
    """What was imagined of N candidate plans over H steps with P particles, reduced over the particles.

    Attributes:
        value: mean over particles of every member's V(z_H), ``[*B, N, M]``.
        goal_prob: mean probability of the goal at each step, ``[*B, N, H]``.
        constraint_prob: largest (or mean) probability of a violation at each step, ``[*B, N, H]``.
        safe_set_prob: mean (or smallest) probability that z_H lies in the safe set, ``[*B, N]``.
    """

    value: Tensor
    goal_prob: Tensor
    constraint_prob: Tensor
    safe_set_prob: Tensor


def objective(statistics: PlanStatistics, *, pessimism: float = 0.0, goal_reduction: GoalReduction = "count") -> Tensor:
    """Mean of V(z_H) over particles and members + imagined steps in the goal, ``[*B, N]``.

    Counting steps in the goal (mean goal probability above one half) equals summing the rewards −1 and 0 up
    to the constant H; summing the probabilities equals the expectation of that sum, and tells the middle of the goal
    from its doubtful edge.

    Args:
        statistics: of the candidates.
        goal_reduction: over steps, ``"count"`` as the authors' code, or ``"expected"``.
        pessimism: κ ≥ 0, subtracts κ standard deviations over members; 0 is the paper.
    """
    value = statistics.value.mean(-1)
    if pessimism > 0.0:
        value = value - pessimism * statistics.value.std(-1, correction=0)
    in_goal = statistics.goal_prob if goal_reduction == "expected" else statistics.goal_prob > 0.5
    return value + in_goal.sum(-1)


def feasible(statistics: PlanStatistics, *, safe_set_threshold: Tensor | float, constraint_threshold: float) -> Tensor:
    """Bool ``[*B, N]``: no step violates (probability ≤ δ_C) and the end is safe (probability ≥ δ_S).

    Args:
        statistics: of the candidates.
        safe_set_threshold: δ_S, a number or ``[*B, 1]``.
        constraint_threshold: δ_C.
    """
    satisfied = (statistics.constraint_prob <= constraint_threshold).all(-1)
    return satisfied & (statistics.safe_set_prob >= safe_set_threshold)


def least_harm(statistics: PlanStatistics, *, constraint_threshold: float) -> Tensor:
    """Ranking for when nothing is feasible, ``[*B, N]``: fewest violating steps, then the safest end.

    Args:
        statistics: of the candidates.
        constraint_threshold: δ_C.
    """
    violations = (statistics.constraint_prob > constraint_threshold).sum(-1)
    # A probability of at most one half of a step keeps the order lexicographic.
    return torch.as_tensor(0.5 * statistics.safe_set_prob - violations)
