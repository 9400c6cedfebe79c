"""What a plan is worth and whether it may be carried out, kept apart."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ls3_torchrl.planners.optimizer import PlanScores


class PlanStatistics(NamedTuple):
    """What was imagined of N candidate plans over H steps with P particles, reduced over the particles.

    Attributes:
        value: mean over particles of every member's V(z_H), ``[*B, N, M]``.
        goal_prob: mean probability of the goal at each step, ``[*B, N, H]``.
        constraint_prob: largest probability over particles of a violation at each step, ``[*B, N, H]``.
        safe_set_prob: mean (or smallest) probability that z_H lies in the safe set, ``[*B, N]``.
    """

    value: Tensor
    goal_prob: Tensor
    constraint_prob: Tensor
    safe_set_prob: Tensor


def objective(statistics: PlanStatistics) -> Tensor:
    """Mean of V(z_H) over particles and members + imagined steps in the goal, ``[*B, N]``.

    Counting steps in the goal (mean goal probability above one half) equals summing the rewards −1 and 0 up
    to the constant H.

    Args:
        statistics: of the candidates.
    """
    return statistics.value.mean(-1) + (statistics.goal_prob > 0.5).sum(-1)


def feasible(statistics: PlanStatistics, *, safe_set_threshold: Tensor | float, constraint_threshold: float) -> Tensor:
    """Bool ``[*B, N]``: no step violates (probability ≤ δ_C) and the end is safe (probability ≥ δ_S).

    Args:
        statistics: of the candidates.
        safe_set_threshold: δ_S, a number or ``[*B, 1]``.
        constraint_threshold: δ_C.
    """
    satisfied = (statistics.constraint_prob <= constraint_threshold).all(-1)
    return satisfied & ends_inside(statistics, safe_set_threshold=safe_set_threshold)


def ends_inside(statistics: PlanStatistics, *, safe_set_threshold: Tensor | float) -> Tensor:
    """Bool ``[*B, N]``: the end lies in the safe set (probability ≥ δ_S); see :func:`feasible`."""
    return statistics.safe_set_prob >= safe_set_threshold


def least_harm(statistics: PlanStatistics, *, constraint_threshold: float, safe_set: bool = True) -> Tensor:
    """Ranking for when nothing is feasible, ``[*B, N]``: fewest violating steps, then the safest end.

    NaN where a probability is: nobody knows what such a plan would do.

    Args:
        statistics: of the candidates.
        constraint_threshold: δ_C.
        safe_set: whether the end is asked for; of plans with as many violating steps, those come first otherwise that
            are the least likely to violate in any one step.
    """
    violations = (statistics.constraint_prob > constraint_threshold).sum(-1)
    unknown = statistics.constraint_prob.isnan().any(-1)
    safest = statistics.safe_set_prob if safe_set else 1.0 - statistics.constraint_prob.amax(-1)
    # A probability of at most one half of a step keeps the order lexicographic.
    return (0.5 * safest - violations).masked_fill(unknown, torch.nan)


def require_sound(statistics: PlanStatistics, scores: PlanScores) -> None:
    """Refuse to choose among plans of which nothing is known.

    Single plans may be lost to overflow; they rank last. Where all plans of a row are, or the value of all its feasible
    ones, any choice would be a random one.

    Args:
        statistics: of the candidates.
        scores: what the planner made of them.

    Raises:
        FloatingPointError: naming what is not finite.
    """
    unknown = scores.fallback.isnan().all(-1)
    unvalued = scores.feasible.any(-1) & ~(scores.feasible & scores.score.isfinite()).any(-1)
    if not (unknown | unvalued).any():
        return
    wrong = []
    if unknown.any():
        rows = unknown.nonzero().flatten()
        parts = {"constraint estimator": statistics.constraint_prob, "safe set": statistics.safe_set_prob}
        wrong = [f"the {name}'s probabilities" for name, part in parts.items() if part[rows].isnan().any()]
        if len(wrong) == 2:
            wrong = ["the imagined latents (or both classifiers)"]
    else:
        rows = unvalued.nonzero().flatten()
        wrong = ["the value (or the goal estimator's probabilities)"]
    raise FloatingPointError(
        f"No plan can be judged in {len(rows)} of {len(unknown)} rows, the first being {int(rows[0])}: {wrong[0]} are "
        "not finite for all candidates. The networks' weights are not finite, or their outputs overflow: load weights "
        "from before the training diverged."
    )
