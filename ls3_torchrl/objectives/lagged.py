"""What the losses have in common whose targets a lagged copy of the network computes."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from ls3_torchrl.objectives.base import LatentLoss


class LaggedTargetLoss(LatentLoss):
    """Base class of a loss to targets that a lagged copy of the trained network computes.

    A batch may hold its targets, under the accepted key that :attr:`target_name` names; where it does not, the loss
    computes them. The lagged network is the same from one copy to the next: the targets of all batches in between can
    be computed at once.

    Attributes:
        target_name: an accepted key, which is optional.
    """

    target_name: str

    @property
    def target_key(self) -> NestedKey:
        """Where a batch may hold its targets."""
        return getattr(self.tensor_keys, self.target_name)

    def targets(self, tensordict: TensorDictBase) -> Tensor:
        """What the loss computes for a batch that holds no targets."""
        raise NotImplementedError

    def targets_of(self, tensordict: TensorDictBase) -> Tensor:
        """The targets that a batch holds, or else :meth:`targets`."""
        found = tensordict.get(self.target_key, None)
        return self.targets(tensordict) if found is None else found

    @property
    def has_targets_by_row(self) -> bool:
        """Whether it is certain that a row's target depends on that row alone, whatever else the batch holds."""
        return False
