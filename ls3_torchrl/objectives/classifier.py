"""The constraint and goal estimators' cross-entropy (section 1.1.1)."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from ls3_torchrl._checks import require_labels
from ls3_torchrl.modules.classifiers import LatentClassifier, SafeSet
from ls3_torchrl.objectives.base import require_shape_of
from ls3_torchrl.objectives.head import HeadLoss


class ClassifierLoss(HeadLoss):
    """Binary cross-entropy of a latent classifier to a label of the state that was reached.

    A :class:`~ls3_torchrl.modules.LatentClassifier` knows its name and its label. For any other module the label of
    ``"goal"`` is ``("next", "success")``, and that of another name is ``("next", name)``.

    Args:
        classifier: any module whose first output is a logit ``[*B, 1]``.
        name: the loss is returned as ``loss_{name}``; by default the classifier's own, or ``"constraint"``.

    Returns:
        The scalar ``loss_{name}`` and, detached, ``{name}_accuracy`` at probability one half.

    Raises:
        TypeError: for a safe set, which has no labels.
        ValueError: for labels of another shape than the logits, or other labels than 0 to 1.
        KeyError: when a key is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import GoalEstimator
        >>> loss = ClassifierLoss(GoalEstimator(8))
        >>> reached = {"latent": torch.zeros(4, 8), "success": torch.ones(4, 1, dtype=torch.bool)}
        >>> loss(TensorDict({"next": reached}, [4]))["loss_goal"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            latent (NestedKey): the state to classify.
            label (NestedKey): its label, bool ``[B, 1]``; the default is the classifier's own.
        """

        latent: NestedKey = ("next", "latent")
        label: NestedKey = ("next", "constraint")

    head = "classifier"
    classifier: TensorDictModuleBase

    def __init__(self, classifier: TensorDictModuleBase, *, name: str | None = None) -> None:
        super().__init__()
        if isinstance(classifier, SafeSet):
            raise TypeError(
                f"{type(classifier).__name__} has no labels to learn from: its targets come from its own lagged copy. "
                "Train it with SafeSetLoss."
            )
        self.classifier = classifier
        own_name, label = None, None
        if isinstance(classifier, LatentClassifier):
            own_name, label = classifier.name, classifier.label_key
        self.name: str = name or own_name or "constraint"
        self.out_keys = [f"loss_{self.name}", f"{self.name}_accuracy"]
        if label is None:
            label = ("next", "success" if self.name == "goal" else self.name)
        self._start_from_keys(label=label)

    def losses_of(self, logit: Tensor, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Cross-entropy and accuracy of logits ``[B, 1]`` on states ``[B]``."""
        keys = self.tensor_keys
        label = tensordict.get(keys.label)
        require_shape_of(label, logit, keys.label, f"ClassifierLoss of {self.name!r}")
        require_labels(label, keys.label)
        hits = ((logit.detach() > 0) == label.bool()).float()
        return {
            f"loss_{self.name}": binary_cross_entropy_with_logits(logit, label.to(logit)),
            f"{self.name}_accuracy": hits.mean(),
        }
