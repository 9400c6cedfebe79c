"""The constraint and goal estimators' cross-entropy (section 1.1.1)."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey, TensorDictBase
from torch.nn.functional import binary_cross_entropy_with_logits
from torchrl.objectives import LossModule

from ls3_torchrl._checks import require_keys
from ls3_torchrl.modules.call import call_on_latent
from ls3_torchrl.modules.classifiers import LatentClassifier
from ls3_torchrl.objectives._common import as_scalars


class ClassifierLoss(LossModule):
    """Binary cross-entropy of a latent classifier to a label of the state that was reached.

    The defaults fit the constraint estimator; for the goal estimator use ``name="goal"`` and
    ``set_keys(label=("next", "success"))``.

    Args:
        classifier: writes a logit.
        name: the loss is returned as ``loss_{name}``.

    Returns:
        The scalar ``loss_{name}`` and, detached, ``{name}_accuracy`` at probability one half.

    Raises:
        KeyError: when a key is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import GoalEstimator
        >>> loss = ClassifierLoss(GoalEstimator(8), name="goal")
        >>> loss.set_keys(label=("next", "success"))
        >>> reached = {"latent": torch.zeros(4, 8), "success": torch.ones(4, 1, dtype=torch.bool)}
        >>> loss(TensorDict({"next": reached}, [4]))["loss_goal"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            latent (NestedKey): the state to classify.
            label (NestedKey): its label, bool ``[B, 1]``.
        """

        latent: NestedKey = ("next", "latent")
        label: NestedKey = ("next", "constraint")

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    classifier: LatentClassifier

    def __init__(self, classifier: LatentClassifier, *, name: str = "constraint") -> None:
        super().__init__()
        self.classifier = classifier
        self.name = name
        self.out_keys = [f"loss_{name}", f"{name}_accuracy"]

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys that are read, as ``set_keys`` left them."""
        keys = self.tensor_keys
        return [keys.latent, keys.label]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        pass

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss on states ``[B]``."""
        keys = self.tensor_keys
        require_keys(tensordict, self.in_keys, "ClassifierLoss")
        label = tensordict.get(keys.label)
        logit = call_on_latent(self.classifier, tensordict.get(keys.latent))
        hits = ((logit.detach() > 0) == label.bool()).float()
        return as_scalars(
            **{
                f"loss_{self.name}": binary_cross_entropy_with_logits(logit, label.to(logit)),
                f"{self.name}_accuracy": hits.mean(),
            }
        )
