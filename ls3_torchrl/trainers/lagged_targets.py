"""Targets of a lagged network, for all batches at once that are trained on before its next copy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from ls3_torchrl.data import BatchStream
from ls3_torchrl.objectives.lagged import LaggedTargetLoss

#: Rows that are computed at once: enough for fast products, and few enough to stay in a core's cache.
_ROWS = 8192


class LaggedTargets:
    """Gives each batch of a stream the targets that a loss would compute for it.

    The lagged network is the same between two of its copies. One product for all batches of that time takes a fraction
    of what one for each does, whose rows are few. Where the loss does not promise that targets are computed row by row,
    or batches are none of the stream's, it computes them as it always does.

    Args:
        loss: computes the targets.
        batches: where its batches come from.
        interval: gradient steps between copies.
        compute: makes the targets of rows.
    """

    def __init__(
        self,
        loss: LaggedTargetLoss,
        batches: BatchStream,
        interval: int,
        compute: Callable[[TensorDictBase], Tensor],
    ) -> None:
        self.batches = batches
        self._loss, self._interval, self._compute = loss, interval, compute
        self._of: tuple[Any, ...] = ()  # what the targets were computed of, and with
        self._drawn: TensorDictBase | None = None
        self._first = 0
        self._targets: tuple[Tensor, ...] = ()

    def add_to(self, batch: TensorDictBase, steps: int, left: int) -> None:
        """Write the targets of the batch that the stream has just handed over.

        Args:
            batch: gets them.
            steps: taken since the last copy.
            left: steps of the phase, this one included.
        """
        drawn, number = self.batches.drawn, self.batches.taken - 1
        if drawn is None or not (self._loss.is_plain and self._loss.has_targets_by_row):
            return
        copy = number - steps
        weights = self._loss.lagged_weights
        versions = [weight._version for weight in weights.by_name.values()]
        of = id(drawn), copy, self._loss.target_settings, weights, versions
        if self._of != of:
            # From the copy, or the first batch that was drawn, on: a run that continues in between computes the same.
            first, end = max(0, copy), min(copy + self._interval, number + left)
            together = max(1, _ROWS // drawn[0].numel())
            parts = drawn[first:end].split(together) if first <= number < end else ()
            self._of, self._drawn, self._first = of, drawn, first  # kept: no other gets its id
            self._targets = tuple(target for part in parts for target in self._targets_of(part))
        if self._targets:
            batch.set(self._loss.target_key, self._targets[number - self._first])

    def _targets_of(self, batches: TensorDictBase) -> tuple[Tensor, ...]:
        """Those of batches ``[K, *batch]``."""
        return self._compute(batches.flatten(0, 1)).unflatten(0, batches.shape[:2]).unbind(0)

    def __getstate__(self) -> dict[str, Any]:
        """All but what is computed ahead, which is computed again."""
        return vars(self) | {"_of": (), "_drawn": None, "_first": 0, "_targets": ()}
