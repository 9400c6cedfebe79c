"""Means over runs, with intervals that say how far few runs can be trusted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats

#: Resamples of a bootstrap, and the fraction of them that an interval holds.
RESAMPLES, CONFIDENCE = 2000, 0.95


class Estimate(NamedTuple):
    """A mean over runs and its interval; NaN for that of a single run.

    Attributes:
        middle: the mean.
        low: end of the interval.
        high: its other end.
    """

    middle: np.ndarray
    low: np.ndarray
    high: np.ndarray


def interquartile_mean(values: np.ndarray, axis: int = 0) -> np.ndarray:
    """Mean of the middle half of the runs, as Agarwal et al. (2021) recommend for few of them.

    Of three runs or fewer, all are in the middle.

    Example:
        >>> float(interquartile_mean(np.array([0.0, 2.0, 4.0, 100.0])))
        3.0
    """
    return stats.trim_mean(values, 0.25, axis=axis)


def estimate(values: np.ndarray, *, trimmed: bool = True) -> Estimate:
    """Interquartile mean over the first axis, or mean, with a percentile-bootstrap interval over runs.

    Args:
        values: one row a run, ``[n, ...]``.
        trimmed: leave out the outer halves. Rates of violations are not trimmed: that would hide the runs that violate.

    Example:
        >>> estimate(np.array([1.0, 1.0, 1.0])).low.item()
        1.0
    """
    values = np.asarray(values, dtype=float)

    def mean(sample: np.ndarray, axis: int = 0) -> np.ndarray:
        return interquartile_mean(sample, axis) if trimmed else np.mean(sample, axis=axis)

    middle = np.asarray(mean(values))
    if len(values) < 2:
        return Estimate(middle, np.full_like(middle, np.nan), np.full_like(middle, np.nan))
    rows = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    outer = 100 * (1 - CONFIDENCE) / 2
    low, high = np.percentile(mean(values[rows], axis=1), [outer, 100 - outer], axis=0)
    return Estimate(middle, np.asarray(low), np.asarray(high))
