"""What the losses of the three classifiers have in common, and what it takes to compute several at once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from ls3_torchrl.layers import is_relu_mlp
from ls3_torchrl.modules.call import Weights, asks_of_latent_alone, call_on_latent, is_hooked
from ls3_torchrl.modules.classifiers import LatentClassifier, redefines
from ls3_torchrl.modules.ensemble import run_stacked
from ls3_torchrl.objectives.base import LatentLoss

#: A network's layers: weight ``[out, in]`` and bias ``[out]``, ReLU between them.
Layers = list[tuple[Tensor, Tensor]]


class HeadLoss(LatentLoss):
    """Base class of a loss of the logits that one network gives to latents.

    A subclass names the network, and says what its logits cost. It can be computed together with others like it
    (:class:`StackedHeads`).

    Attributes:
        head: the attribute that is the network.
    """

    head: str

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The loss on states ``[B]``."""
        logit = call_on_latent(getattr(self, self.head), self.latent(tensordict), params=self._head_weights())
        return self.losses_of(logit, tensordict)

    def latent(self, tensordict: TensorDictBase) -> Tensor:
        """What the network sees, ``[B, D]``."""
        return tensordict.get(self.tensor_keys.latent)

    def losses_of(self, logit: Tensor, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """What the loss returns for logits ``[B, 1]``."""
        raise NotImplementedError

    def _head_weights(self) -> Weights | None:
        return self._weights(self.head) if hasattr(self, f"{self.head}_params") else None

    def relu_layers(self) -> Layers | None:
        """The layers of the network, if it is linear layers with ReLU between them and nothing else."""
        head = getattr(self, self.head)
        own = isinstance(head, LatentClassifier) and asks_of_latent_alone(head)
        if not own or redefines(head, LatentClassifier, "of_latent") or not is_relu_mlp(head.network):
            return None
        if any(is_hooked(part) for part in head.network.modules()):
            return None
        linear = {f"network.{i}": layer for i, layer in enumerate(head.network) if isinstance(layer, nn.Linear)}
        weights = self._head_weights()
        if weights is None:
            return [(layer.weight, layer.bias) for layer in linear.values()]
        return [(weights.by_name[f"{name}.weight"], weights.by_name[f"{name}.bias"]) for name in linear]


class StackedHeads:
    """Losses whose networks have one shape, computed with one batched product a layer for all of them.

    Args:
        losses: of which :meth:`can_stack` is true.

    Example:
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import ConstraintEstimator, GoalEstimator
        >>> from ls3_torchrl.objectives import ClassifierLoss
        >>> losses = [ClassifierLoss(ConstraintEstimator(8)), ClassifierLoss(GoalEstimator(8))]
        >>> no = torch.zeros(4, 1, dtype=torch.bool)
        >>> batch = TensorDict({"next": {"latent": torch.zeros(4, 8), "constraint": no, "success": no}}, [4])
        >>> StackedHeads.can_stack(losses), [sorted(found) for found in StackedHeads(losses).losses([batch, batch])]
        (True, [['constraint_accuracy', 'loss_constraint'], ['goal_accuracy', 'loss_goal']])
    """

    def __init__(self, losses: Sequence[HeadLoss]) -> None:
        self._losses = list(losses)
        self._layers = [loss.relu_layers() or [] for loss in losses]

    @staticmethod
    def can_stack(losses: Sequence[LatentLoss]) -> bool:
        """Whether they are losses of networks of one shape."""
        if not all(
            isinstance(one, HeadLoss) and one.is_plain and type(one).losses is HeadLoss.losses for one in losses
        ):
            return False
        found = [loss.relu_layers() for loss in losses]  # type: ignore[attr-defined]
        shapes = {None if one is None else tuple((weight.shape, weight.dtype) for weight, _ in one) for one in found}
        return None not in shapes and len(shapes) == 1

    def losses(self, batches: Sequence[TensorDictBase]) -> list[dict[str, Tensor]]:
        """What each loss returns for its batch; all batches have one size."""
        latents = torch.stack([loss.latent(rows) for loss, rows in zip(self._losses, batches, strict=True)])
        layers = [
            (torch.stack([weight for weight, _ in layer]).mT, torch.stack([bias for _, bias in layer]).unsqueeze(1))
            for layer in zip(*self._layers, strict=True)
        ]
        logits = run_stacked(latents, layers).unbind(0)
        return [loss.losses_of(*given) for loss, *given in zip(self._losses, logits, batches, strict=True)]
