"""Equation (5): the safe set's Bellman-style loss."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from ls3_torchrl._checks import require_labels, require_unit_interval
from ls3_torchrl.modules.call import call_on_latent
from ls3_torchrl.objectives.base import require_shape_of
from ls3_torchrl.objectives.head import HeadLoss
from ls3_torchrl.objectives.lagged import LaggedTargetLoss


class SafeSetLoss(HeadLoss, LaggedTargetLoss):
    """Binary cross-entropy of f_S(z_t) to max(1_S(z_t), γ_S f_S'(z_{t+1})) (equation (5)).

    Rows may carry a weight under ``weight``; those of a trajectory that neither succeeded nor violated, say, tell
    little of whether its states are safe. Without the key all rows count alike, as in the paper.

    The target is built by a lagged copy f_S' of the safe set itself: fixed-point iteration. Couple it with
    ``HardUpdate(loss, value_network_update_interval=99)`` for a copy every 100 updates.

    Args:
        safe_set: any module whose first output is the logit ``[*B, 1]`` of f_S.
        gamma: γ_S in [0, 1] (Table 1: 0.3 for Navigation and Reacher, 0.9 for the others).

    Returns:
        The scalar ``loss_safe_set``.

    Raises:
        ValueError: for γ_S outside [0, 1], labels or weights of another shape than the logits, labels other than 0 to
            1, or negative weights.
        KeyError: when a key is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import SafeSet
        >>> from torchrl.objectives import HardUpdate
        >>> loss = SafeSetLoss(SafeSet(8))
        >>> updater = HardUpdate(loss, value_network_update_interval=99)
        >>> z, label = torch.zeros(4, 8), torch.ones(4, 1, dtype=torch.bool)
        >>> batch = TensorDict({"latent": z, "in_success": label, "next": {"latent": z}}, [4])
        >>> loss(batch)["loss_safe_set"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            latent (NestedKey): z_t.
            next_latent (NestedKey): z_{t+1}.
            in_success (NestedKey): 1_S(z_t), the state is part of a trajectory that still succeeds.
            weight (NestedKey): weight of each row in the mean, optional.
            lagged_safe_set_target (NestedKey): what f_S(z_t) is compared with; computed where a batch lacks it.
        """

        latent: NestedKey = "latent"
        next_latent: NestedKey = ("next", "latent")
        in_success: NestedKey = "in_success"
        weight: NestedKey = "safe_set_weight"
        lagged_safe_set_target: NestedKey = "lagged_safe_set_target"

    _optional = frozenset({"weight", "lagged_safe_set_target"})

    head = "safe_set"
    target_name, lagged = "lagged_safe_set_target", "safe_set"
    safe_set: TensorDictModuleBase
    safe_set_params: TensorDictParams
    target_safe_set_params: TensorDictParams

    def __init__(self, safe_set: TensorDictModuleBase, *, gamma: float = 0.3) -> None:
        super().__init__()
        self.convert_to_functional(safe_set, "safe_set", create_target_params=True)
        self.out_keys = ["loss_safe_set"]
        self.gamma = require_unit_interval(gamma, "gamma (of the safe set)")

    def target(self, next_latent: Tensor, in_success: Tensor) -> Tensor:
        """max(1_S(z_t), γ_S f_S'(z_{t+1})), a probability ``[B, 1]``."""
        with torch.no_grad():
            next_safe = call_on_latent(self.safe_set, next_latent, params=self._weights("target_safe_set")).sigmoid()
        require_shape_of(in_success, next_safe, self.tensor_keys.in_success, "SafeSetLoss")
        require_labels(in_success, self.tensor_keys.in_success)
        return torch.maximum(in_success.to(next_safe), self.gamma * next_safe)

    def targets(self, tensordict: TensorDictBase) -> Tensor:
        """:meth:`target` of transitions."""
        keys = self.tensor_keys
        return self.target(tensordict.get(keys.next_latent), tensordict.get(keys.in_success))

    @property
    def target_settings(self) -> tuple[float, ...]:
        """γ_S."""
        return (self.gamma,)

    @property
    def has_targets_by_row(self) -> bool:
        """Whether the safe set is a network of this library, and nobody else is told when it is called."""
        return type(self) is SafeSetLoss and self.relu_layers() is not None

    def losses_of(self, logit: Tensor, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The loss of logits ``[B, 1]`` on transitions ``[B]``."""
        keys = self.tensor_keys
        target = self.given_or_computed_targets(tensordict)
        require_shape_of(target, logit, self.target_key, "SafeSetLoss")
        weight = tensordict.get(keys.weight, None)
        if weight is not None:
            require_shape_of(weight, logit, keys.weight, "SafeSetLoss")
            if not torch.compiler.is_compiling() and (weight < 0).any():
                raise ValueError(
                    f"SafeSetLoss needs weights {keys.weight!r} of at least 0, got {weight.min().item():.4g}."
                )
        return {"loss_safe_set": binary_cross_entropy_with_logits(logit, target, weight)}
