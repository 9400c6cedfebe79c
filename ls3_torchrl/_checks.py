"""Checks of inputs, with messages that say what was received, what is allowed and what to do."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor


class DataWarning(UserWarning):
    """Says what was converted in data of one's own, or what looks wrong in them although it may be meant."""


def require_keys(tensordict: TensorDictBase, keys: Iterable[NestedKey], who: str) -> None:
    """Raise ``KeyError`` when ``tensordict`` lacks one of ``keys``, naming those that it has."""
    missing = [key for key in keys if tensordict.get(key, None) is None]
    if missing:
        there = sorted(map(str, tensordict.keys(include_nested=True, leaves_only=True)))
        raise KeyError(
            f"{who} needs the keys {missing}, which the tensordict lacks. It has: {', '.join(there) or 'none'}. "
            "Check the spelling, or point the module at other keys through its *_key arguments or set_keys()."
        )


def require_finite(value: Tensor, what: str) -> None:
    """Raise ``ValueError`` when ``value`` holds NaN or infinity; skipped while compiling."""
    if torch.compiler.is_compiling() or not value.is_floating_point():
        return
    if torch.isfinite(value.detach().sum()):  # one pass over the data tells in nearly all cases
        return
    if not torch.isfinite(value).all():
        bad = int((~torch.isfinite(value)).sum())
        raise ValueError(
            f"{what} is not finite: {bad} of {value.numel()} values are NaN or infinite. "
            "Look for a diverged training or a faulty sensor upstream."
        )


def require_probability(value: float, name: str) -> float:
    """Return ``value`` when it lies strictly between 0 and 1; raise ``ValueError`` otherwise."""
    if not 0.0 < value < 1.0:
        raise ValueError(f"{name} must lie strictly between 0 and 1 (it is a probability), got {value}.")
    return float(value)


def require_unit_interval(value: float, name: str) -> float:
    """Return ``value`` when it lies in [0, 1], ends included; raise ``ValueError`` otherwise."""
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"{name} must lie in [0, 1], got {value}.")
    return float(value)


def require_choice(value: str, allowed: Iterable[str], name: str) -> str:
    """Return ``value`` when it is one of ``allowed``; raise ``ValueError`` otherwise."""
    options = tuple(allowed)
    if value not in options:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, options))}; got {value!r}.")
    return value


def require_at_least(value: int, low: int, name: str) -> int:
    """Return ``value`` when it is ``low`` or more; raise ``ValueError`` otherwise."""
    if value < low:
        raise ValueError(f"{name} must be at least {low}, got {value}.")
    return value


def require_positive(value: float, name: str) -> float:
    """Return ``value`` when it is a finite number above 0; raise ``ValueError`` otherwise."""
    if not 0.0 < value < float("inf"):
        raise ValueError(f"{name} must be a finite number above 0, got {value}.")
    return value
