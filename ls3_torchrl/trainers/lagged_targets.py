"""Targets of a lagged network, for all batches at once that are trained on before its next copy."""

from __future__ import annotations

from collections.abc import Callable

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
    it computes them as it always does.

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
        self._loss, self._batches, self._interval, self._compute = loss, batches, interval, compute
        self._drawn: TensorDictBase | None = None
        self._first = 0
        self._targets: tuple[Tensor, ...] = ()

    def add_to(self, batch: TensorDictBase, steps: int) -> None:
        """Write the targets of the batch that the stream has just handed over.

        Args:
            batch: gets them.
            steps: taken since the last copy.
        """
        drawn, number = self._batches.drawn, self._batches.taken - 1
        assert drawn is not None
        # From the copy, or the first batch that was drawn, on: a run that continues in between computes the same.
        first = max(0, number - steps)
        if drawn is not self._drawn or first != self._first:
            self._drawn, self._first, self._targets = drawn, first, ()
            if self._loss.is_plain and self._loss.has_targets_by_row:
                rows = drawn[first : number - steps + self._interval]
                together = max(1, _ROWS // rows[0].numel())
                self._targets = tuple(target for part in rows.split(together) for target in self._of(part))
        if self._targets:
            batch.set(self._loss.target_key, self._targets[number - first])

    def _of(self, batches: TensorDictBase) -> tuple[Tensor, ...]:
        """Those of batches ``[K, *batch]``."""
        return self._compute(batches.flatten(0, 1)).unflatten(0, batches.shape[:2]).unbind(0)
