"""How many violations calibrated thresholds miss, and what the constraint estimator's probabilities are worth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.axes import Axes
from tensordict import TensorDictBase
from torch import Tensor

from ls3_recipes.plots.style import GOAL, INK, PALE, SAFE, UNSAFE, grid, picture

_BINS = 10


def plot_calibration(
    path: Path, levels: Sequence[dict[str, Any]], violations: TensorDictBase, calm: TensorDictBase
) -> None:
    """Missed violations against α, reliability of f_C, and its values on violations and before them.

    Args:
        path: of the picture.
        levels: of the summary, one for each α.
        violations: what was foreseen of the steps into a violation.
        calm: what was foreseen of steps before these.
    """
    with picture(path, 1, 3, (10.5, 3.2)) as (_, axes):
        _plot_missed(axes[0, 0], levels, len(violations))
        _plot_reliability(axes[0, 1], violations["constraint_prob"], calm["constraint_prob"])
        _plot_values(axes[0, 2], violations["constraint_prob"], calm["constraint_prob"])


def _plot_missed(axis: Axes, levels: Sequence[dict[str, Any]], count: int) -> None:
    alpha = [level["alpha"] for level in levels]
    axis.plot([0.0, max(alpha)], [0.0, max(alpha)], color=PALE, label="α, the most that may be")
    for name, label, colour in (
        ("missed_by_constraint", "missed by δ$_C$", UNSAFE),
        ("missed_by_safe_set", "missed by δ$_S$", SAFE),
    ):
        missed = [level[name] for level in levels]
        spread = [1.96 * math.sqrt(a * (1 - a) / count) for a in alpha]
        axis.errorbar(alpha, missed, spread, color=colour, marker="o", ms=4, lw=1, capsize=2, label=label)
    axis.set(title=f"Missed of {count} new violations", xlabel="α", ylabel="share missed")
    axis.legend(fontsize=8)
    grid(axis)


def _plot_reliability(axis: Axes, violations: Tensor, calm: Tensor) -> None:
    probability = torch.cat([violations, calm])
    happened = torch.cat([torch.ones_like(violations), torch.zeros_like(calm)])
    place = (probability * _BINS).long().clamp(max=_BINS - 1)
    there = [k for k in range(_BINS) if (place == k).any()]
    said = [float(probability[place == k].mean()) for k in there]
    seen = [float(happened[place == k].mean()) for k in there]
    axis.plot([0, 1], [0, 1], color=PALE, label="as often as said")
    axis.plot(said, seen, color=INK, marker="o", ms=4, lw=1, label="steps by f$_C$, in tenths")
    axis.set(title="Reliability of f$_C$", xlabel="probability foreseen", ylabel="share that violated")
    axis.legend(fontsize=8)
    grid(axis)


def _plot_values(axis: Axes, violations: Tensor, calm: Tensor) -> None:
    bins = [k / 40 for k in range(41)]
    for values, label, colour in ((calm, "steps before", GOAL), (violations, "steps into a violation", UNSAFE)):
        share = torch.full_like(values, 1.0 / len(values))
        axis.hist(values.tolist(), bins, weights=share.tolist(), color=colour, alpha=0.7, label=label)
    axis.set(title="What f$_C$ foresees", xlabel="f$_C$", ylabel="share of steps", yscale="log")
    axis.legend(fontsize=8)
    grid(axis)
