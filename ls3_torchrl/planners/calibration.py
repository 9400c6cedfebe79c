"""Calibration: thresholds that miss at most a chosen share of violations (split conformal prediction)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ls3_torchrl._checks import require_finite, require_keys
from ls3_torchrl.planners.imagination import sample_imagination_noise
from ls3_torchrl.planners.ls3 import LS3Planner

#: Products such as 0.1 · 10 are not whole in floating point.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Calibration:
    """Thresholds of a planner, found on violations that nothing was trained on.

    Attributes:
        alpha: α, the largest share of violations that either threshold misses.
        violations: how many it was found on.
        constraint_threshold: the largest δ_C that does so.
        safe_set_threshold: the smallest δ_S that does so.
    """

    alpha: float
    violations: int
    constraint_threshold: float
    safe_set_threshold: float


def conformal_threshold(score: Tensor, alpha: float) -> float:
    """The largest δ such that a new score is at most δ with probability α or less.

    Of n sorted scores it is the k-th, k = ⌊α (n + 1)⌋, or rather the number before it: a new score that is exchangeable
    with the n is as likely to take each of the n + 1 places among them, and is missed in the first k alone. That holds
    for any estimator, however bad, in the mean over sets of n and new scores alike.

    Args:
        score: of n cases, any shape; for example the probability of a violation that was given to each of n violations.
        alpha: α in (0, 1).

    Raises:
        ValueError: for too few cases, n < 1/α − 1, or scores that are not finite.

    Source: Vovk, Gammerman and Shafer, "Algorithmic Learning in a Random World", 2005; Angelopoulos and Bates, "A
    Gentle Introduction to Conformal Prediction", arXiv 2107.07511, section 1.

    Example:
        >>> round(conformal_threshold(torch.linspace(0.05, 0.95, 19), alpha=0.1), 3)
        0.1
    """
    if not 0.0 < alpha < 1.0:
        raise ValueError(f"alpha must lie between 0 and 1, got {alpha}.")
    ordered = score.detach().flatten().float().sort().values
    require_finite(ordered, "The score")
    k = math.floor(alpha * (len(ordered) + 1) + _ROUNDING)
    if k < 1:
        needed = math.ceil(1.0 / alpha - _ROUNDING) - 1
        raise ValueError(
            f"alpha={alpha} needs {needed} violations at least, got {len(ordered)}. Give more, or a larger alpha."
        )
    return float(torch.nextafter(ordered[k - 1], torch.tensor(-torch.inf)))


@torch.no_grad()
def foresee(planner: LS3Planner, transitions: TensorDictBase) -> TensorDict:
    """What a planner imagines of single steps that were really taken: whether they violate, and where they end.

    Args:
        planner: any.
        transitions: ``[E]``, with what it plans from and the action.

    Returns:
        ``constraint_prob`` and ``safe_set_prob`` ``[E]``, reduced over particles as in its plans.

    Raises:
        KeyError: when an input is missing.
        ValueError: for one that is not finite.

    Example:
        >>> from torchrl.data import Bounded
        >>> from ls3_torchrl import LS3Agent
        >>> planner = LS3Agent(action_spec=Bounded(low=-1.0, high=1.0, shape=(2,)), latent_dim=8).planner()
        >>> images = torch.zeros(3, 3, 64, 64, dtype=torch.uint8)
        >>> foresee(planner, TensorDict({"pixels": images, "action": torch.ones(3, 2)}, [3]))["constraint_prob"].shape
        torch.Size([3])
    """
    require_keys(transitions, [planner.action_key], "foresee")
    latent, action = planner.encode(transitions), transitions.get(planner.action_key)
    require_finite(action, "The action")
    rows = len(latent)
    noise = sample_imagination_noise(planner.env, rows, 1, planner.num_particles, device=latent.device)
    noise = noise._replace(noise=planner.noise_scale * noise.noise)
    seen = planner.imagine(latent, action.float().reshape(rows, 1, 1, -1), noise)
    return TensorDict(
        {"constraint_prob": seen.constraint_prob[:, 0, 0], "safe_set_prob": seen.safe_set_prob[:, 0]}, [rows]
    )


def calibrate(planner: LS3Planner, violations: TensorDictBase, alpha: float) -> Calibration:
    """Find δ_C and δ_S that miss a share α of violations at most.

    A violation is missed by δ_C where the planner gives the step that leads into it a probability f_C ≤ δ_C, and by
    δ_S where it gives the state that violates f_S ≥ δ_S. Either share is at most α in the mean over new violations, if
    these and those given are exchangeable: trajectories of the same behaviour in the same world, none of which the
    agent has learnt from, one step of each. Nothing is promised of the plans that a search prefers, which are not drawn
    at random, nor of δ_S where it is relaxed (``max_relaxations``).

    Args:
        planner: of a trained agent; it is left as it is. Set its ``constraint_threshold`` and ``safe_set_threshold``.
        violations: ``[n]``, the steps into a violation, as :func:`~ls3_torchrl.data.steps_into_violation` finds them.
        alpha: α in (0, 1).

    Raises:
        ValueError: as :func:`conformal_threshold`, and where an estimator is certain of the contrary too often for α.

    Source: :func:`conformal_threshold`.

    Example:
        >>> from torchrl.data import Bounded
        >>> from ls3_torchrl import LS3Agent
        >>> planner = LS3Agent(action_spec=Bounded(low=-1.0, high=1.0, shape=(2,)), latent_dim=8).planner()
        >>> images = torch.zeros(9, 3, 64, 64, dtype=torch.uint8)
        >>> found = calibrate(planner, TensorDict({"pixels": images, "action": torch.ones(9, 2)}, [9]), alpha=0.1)
        >>> planner.constraint_threshold = found.constraint_threshold
    """
    seen = foresee(planner, violations)
    constraint = conformal_threshold(seen["constraint_prob"], alpha)
    safe_set = -conformal_threshold(-seen["safe_set_prob"], alpha)
    for name, certain in (("constraint estimator", constraint < 0.0), ("safe set", safe_set > 1.0)):
        if certain:
            raise ValueError(
                f"The {name} is certain that some of the violations are none, too many of them for alpha={alpha}: no "
                "threshold finds these. Train it longer or on more violations, or take a larger alpha."
            )
    return Calibration(alpha, len(violations), constraint, safe_set)
