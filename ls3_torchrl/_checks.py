"""Checks of tensors, specs and modules, with messages that say what was received, what is allowed and what to do."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Bounded, TensorSpec

from ls3_torchrl._values import (  # noqa: F401  (for those who check both)
    require_at_least,
    require_choice,
    require_positive,
    require_probability,
    require_unit_interval,
)
from ls3_torchrl.exceptions import DataWarning  # noqa: F401


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


def require_labels(labels: Tensor, what: NestedKey) -> None:
    """Raise ``ValueError`` for labels outside [0, 1], for which a cross-entropy has no lower bound; bools are right."""
    if labels.dtype == torch.bool or torch.compiler.is_compiling() or not labels.numel():
        return
    low, high = (float(end) for end in labels.aminmax())
    if not (low >= 0.0 and high <= 1.0):  # NaN as well
        raise ValueError(
            f"The labels {what!r} must be bools or lie in [0, 1]; received values from {low:.4g} to {high:.4g} of "
            f"{labels.dtype}. Compare a cost with a threshold first, for example cost > 0."
        )


def require_size(value: Tensor, size: int, key: NestedKey, who: str) -> None:
    """Raise ``ValueError`` when the last dimension of ``value`` is not ``size``."""
    if value.ndim == 0 or value.shape[-1] != size:
        raise ValueError(
            f"{who} reads {key!r} of shape [*B, {size}], got {list(value.shape)}. Give it what it was made for, or "
            "make it for that size."
        )


def action_bounds(spec: TensorSpec) -> tuple[Tensor, Tensor]:
    """Lowest and highest action ``[A]`` of a spec ``[*B, A]``.

    Raises:
        ValueError: for a spec without bounds, of integers, without dimension, with bounds that are not finite or not in
            order, or with rows that differ.
    """
    if not isinstance(spec, Bounded):
        raise ValueError(
            f"Actions need a bounded spec, got {type(spec).__name__}. Give Bounded(low, high, shape=(A,)) with the "
            "limits that the robot has."
        )
    if not spec.dtype.is_floating_point:
        raise ValueError(f"Actions need a spec of a floating dtype, got {spec.dtype}. Give the limits as floats.")
    if not spec.shape:
        raise ValueError("An action spec needs a dimension, [A]; got shape []. Give a single action as shape [1].")
    low, high = (bound.reshape(-1, spec.shape[-1]) for bound in (spec.space.low, spec.space.high))
    if not (torch.isfinite(low) & torch.isfinite(high) & (low < high)).all():
        raise ValueError(
            f"Actions need finite bounds, low below high; got {low[0].tolist()} and {high[0].tolist()}. Give the "
            "limits that the robot has, and leave out actions that cannot move."
        )
    if (low != low[:1]).any() or (high != high[:1]).any():
        raise ValueError(
            f"The rows of the action spec {list(spec.shape)} differ: from {low.amin(0).tolist()} to "
            f"{low.amax(0).tolist()} below, from {high.amin(0).tolist()} to {high.amax(0).tolist()} above. One planner "
            "acts in one box: scale the actions of each environment to a common one."
        )
    return low[0], high[0]


def require_module(module: object, what: str) -> None:
    """Raise ``TypeError`` for anything but a module that reads and writes tensordicts."""
    if not (isinstance(module, nn.Module) and hasattr(module, "in_keys") and hasattr(module, "out_keys")):
        raise TypeError(
            f"{what} must be a module that reads and writes tensordicts, got {type(module).__name__}. Wrap a plain "
            "network: TensorDictModule(network, in_keys=[...], out_keys=[...])."
        )
