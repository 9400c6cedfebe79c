"""What the library warns of and raises that Python has no name for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tensordict import TensorDictBase


class DataWarning(UserWarning):
    """Says what was converted in data of one's own, or what looks wrong in them although it may be meant."""


class DivergenceError(FloatingPointError):
    """A loss or a gradient is not finite; the networks are as the step before had left them.

    Args:
        phase: in which it happened.
        step: gradient steps taken before.
        scalars: what the losses had written.
        batch: what they were computed on.
        remedy: what to do.

    Example:
        >>> error = DivergenceError("Value", 7, {"loss_value": float("nan")}, None, "Lower its learning rate.")
        >>> print(error)
        Value diverged: {'loss_value': nan} at step 7. Lower its learning rate.
    """

    def __init__(
        self, phase: str, step: int, scalars: Mapping[str, float], batch: TensorDictBase | None, remedy: str
    ) -> None:
        told = not scalars or any(not math.isfinite(value) for value in scalars.values())
        found = "" if told else ", and its gradient is not finite"
        super().__init__(f"{phase} diverged: {dict(scalars) or 'not finite'} at step {step}{found}. {remedy}")
        self.phase, self.step, self.scalars, self.batch = phase, step, dict(scalars), batch
        self.remedy = remedy

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles are made of the same arguments."""
        return type(self), (self.phase, self.step, self.scalars, self.batch, self.remedy)
