"""What the losses have in common whose targets a lagged copy of the network computes."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from ls3_torchrl.modules.call import Weights
from ls3_torchrl.objectives.base import LatentLoss


class LaggedTargetLoss(LatentLoss):
    """Base class of a loss to targets that a lagged copy of the trained network computes.

    Besides its in-keys a batch may hold its targets, under the accepted key that :attr:`target_name` names; where it
    does not, the loss computes them. The lagged network is the same from one copy to the next: the targets of all
    batches in between can be computed at once.

    Attributes:
        target_name: an accepted key, which is optional.
        lagged: the attribute that is the trained network.
    """

    target_name: str
    lagged: str

    @property
    def target_key(self) -> NestedKey | None:
        """Where a batch may hold its targets; ``None`` where a subclass has no key for them."""
        return getattr(self.tensor_keys, self.target_name, None)

    @property
    def lagged_weights(self) -> Weights:
        """Those of the lagged network; another object when they were loaded or moved."""
        return self._weights(f"target_{self.lagged}")

    @property
    def target_settings(self) -> tuple[float, ...]:
        """What else the targets depend on, besides the lagged network and the batch."""
        raise NotImplementedError

    def targets(self, tensordict: TensorDictBase) -> Tensor:
        """What the loss computes for a batch that holds no targets."""
        raise NotImplementedError

    def given_or_computed_targets(self, tensordict: TensorDictBase) -> Tensor:
        """The targets that a batch holds, or else :meth:`targets`."""
        found = None if self.target_key is None else tensordict.get(self.target_key, None)
        return self.targets(tensordict) if found is None else found

    @property
    def has_targets_by_row(self) -> bool:
        """Whether it is certain that a row's target depends on that row alone, whatever else the batch holds."""
        return False
