"""Checks of numbers and words, with messages that say what was received and what is allowed; PyTorch is not needed."""

from __future__ import annotations

from collections.abc import Iterable


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


def require_not_negative(value: float, name: str) -> float:
    """Return ``value`` when it is 0 or more; raise ``ValueError`` otherwise."""
    if not value >= 0.0:
        raise ValueError(f"{name} must not be negative, got {value}.")
    return value
