"""Safe set f_S, constraint estimator f_C and goal estimator f_G: three binary classifiers of a latent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import MLP

from ls3_torchrl._checks import require_keys, require_size
from ls3_torchrl.modules.call import call_on_latent


class LatentClassifier(TensorDictModuleBase):
    """Probability that a latent has a property: 3 hidden layers of 256, a logit out (section 1.1.1).

    A subclass names the property, and where batches hold its label:

    Attributes:
        name: the property; the logit is written under ``"{name}_logit"``, under ``"logit"`` without a name.
        label_key: what :class:`~ls3_torchrl.objectives.ClassifierLoss` learns from, bool ``[*B, 1]``; ``None`` where
            there is no such label.

    Args:
        latent_dim: D.
        hidden: sizes of the hidden layers.
        latent_key: latent ``[*B, D]``.
        logit_key: where the logit ``[*B, 1]`` is written; ``None`` is the key by name.
        prob_key: where the probability ``[*B, 1]`` is written as well; nowhere when ``None``.

    Raises:
        KeyError: when the latent is missing.
        ValueError: for a latent of another size.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> class Slippery(LatentClassifier):
        ...     name = "slippery"
        ...     label_key = ("next", "slippery")
        >>> td = Slippery(latent_dim=8)(TensorDict({"latent": torch.zeros(4, 8)}, [4]))
        >>> td["slippery_logit"].shape
        torch.Size([4, 1])
    """

    name: ClassVar[str | None] = None
    label_key: ClassVar[NestedKey | None] = None

    def __init__(
        self,
        latent_dim: int,
        *,
        hidden: Sequence[int] = (256, 256, 256),
        latent_key: NestedKey = "latent",
        logit_key: NestedKey | None = None,
        prob_key: NestedKey | None = None,
    ) -> None:
        super().__init__()
        if logit_key is None:
            logit_key = "logit" if self.name is None else f"{self.name}_logit"
        self.latent_dim = latent_dim
        self.in_keys = [latent_key]
        self.out_keys = [logit_key] if prob_key is None else [logit_key, prob_key]
        self.network: nn.Module = MLP(
            in_features=latent_dim, out_features=1, num_cells=list(hidden), activation_class=nn.ReLU
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the logit, and the probability where it was asked for."""
        require_keys(tensordict, self.in_keys, type(self).__name__)
        logit = self.of_latent(tensordict.get(self.in_keys[0]))
        tensordict.set(self.out_keys[0], logit)
        if len(self.out_keys) > 1:
            tensordict.set(self.out_keys[1], logit.sigmoid())
        return tensordict

    def of_latent(self, latent: Tensor) -> Tensor:
        """Logits ``[*B, 1]`` of latents ``[*B, D]``."""
        require_size(latent, self.latent_dim, self.in_keys[0], type(self).__name__)
        return self.network(latent)

    def probability(self, latent: Tensor) -> Tensor:
        """Probabilities ``[*B, 1]`` in [0, 1] of latents ``[*B, D]``."""
        return call_on_latent(self, latent).sigmoid()


class SafeSet(LatentClassifier):
    """f_S(z): can a state be brought back into a trajectory that succeeded? (equation (5)).

    Arguments as for :class:`LatentClassifier`. It has no label: :class:`~ls3_torchrl.objectives.SafeSetLoss` makes its
    targets.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> safe_set = SafeSet(latent_dim=8, prob_key="safe_set_prob")
        >>> td = safe_set(TensorDict({"latent": torch.zeros(4, 8)}, [4]))
        >>> td["safe_set_logit"].shape, td["safe_set_prob"].shape
        (torch.Size([4, 1]), torch.Size([4, 1]))
    """

    name = "safe_set"


class ConstraintEstimator(LatentClassifier):
    """f_C(z): does the state violate the constraint? Arguments as for :class:`LatentClassifier`.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> td = ConstraintEstimator(latent_dim=8)(TensorDict({"latent": torch.zeros(4, 8)}, [4]))
        >>> td["constraint_logit"].shape
        torch.Size([4, 1])
    """

    name = "constraint"
    label_key = ("next", "constraint")


class GoalEstimator(LatentClassifier):
    """f_G(z): does the state lie in the goal set? Arguments as for :class:`LatentClassifier`.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> td = GoalEstimator(latent_dim=8)(TensorDict({"latent": torch.zeros(4, 8)}, [4]))
        >>> td["goal_logit"].shape
        torch.Size([4, 1])
    """

    name = "goal"
    label_key = ("next", "success")


def probability_of(classifier: TensorDictModuleBase, latent: Tensor) -> Tensor:
    """Probabilities ``[*B, 1]`` of latents ``[*B, D]``, as the classifier itself would give them.

    By its ``forward``, whose first output is a logit; by its ``probability`` where a subclass of
    :class:`LatentClassifier` has redefined it.

    Example:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> own = TensorDictModule(torch.nn.Linear(8, 1), in_keys=["z"], out_keys=["any_logit"])
        >>> probability_of(own, torch.zeros(4, 8)).shape
        torch.Size([4, 1])
    """
    if isinstance(classifier, LatentClassifier) and redefines(classifier, LatentClassifier, "probability"):
        return classifier.probability(latent)
    return call_on_latent(classifier, latent).sigmoid()


def redefines(module: object, base: type, method: str) -> bool:
    """Whether a method of ``base`` means something else on ``module``: overridden by its class or set on itself."""
    return method in vars(module) or getattr(type(module), method) is not getattr(base, method)
