"""Equations (3) and (4): the value ensemble's losses, offline and online."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor
from torchrl.objectives.value.functional import td0_return_estimate

from ls3_torchrl._checks import require_unit_interval
from ls3_torchrl.modules import ValueEnsemble
from ls3_torchrl.modules.call import call_on_latent, is_hooked
from ls3_torchrl.modules.ensemble import EnsembleMLP
from ls3_torchrl.objectives.base import LatentLoss, check_members, require_ensemble, with_members
from ls3_torchrl.objectives.lagged import LaggedTargetLoss


class OfflineValueLoss(LatentLoss):
    """J(θ) = (V_θ(z_t) − Σ_{i≥0} γ^i r_{t+i})² over batch and members (equation (3)).

    Deviation: the paper's sum starts at i = 1. It starts at 0 here, so that it agrees with equation (4) and
    the switch from one loss to the other moves nothing.

    Args:
        value: any module of the latent whose first output is the value ``[*B, 1]``, or ``[*B, M, 1]`` of M members.
        bootstrap: the batch is ``[B, M]`` and member m learns from column m alone; the value must be an ensemble.

    Returns:
        The scalar ``loss_value``.

    Raises:
        TypeError: for ``bootstrap`` without an ensemble.
        ValueError: when a bootstrap batch has not M columns, or values and targets do not fit.
        KeyError: when a key is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import ValueEnsemble
        >>> loss = OfflineValueLoss(ValueEnsemble(8))
        >>> batch = TensorDict({"latent": torch.zeros(4, 8), "reward_to_go": torch.full((4, 1), -3.0)}, [4])
        >>> loss(batch)["loss_value"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            latent (NestedKey): z_t.
            reward_to_go (NestedKey): discounted sum of the rewards from step t on.
        """

        latent: NestedKey = "latent"
        reward_to_go: NestedKey = "reward_to_go"

    value: TensorDictModuleBase

    def __init__(self, value: TensorDictModuleBase, *, bootstrap: bool = False) -> None:
        super().__init__()
        if bootstrap:
            require_ensemble(value, "OfflineValueLoss")
        self.out_keys = ["loss_value"]
        self.value = value
        self.bootstrap = bootstrap

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The loss on states ``[B]``, or ``[B, M]`` with ``bootstrap``."""
        keys = self.tensor_keys
        latent = tensordict.get(keys.latent)
        if self.bootstrap:
            check_members(latent, self.value, "OfflineValueLoss")
        options = {"per_member": True} if self.bootstrap else {}
        value = call_on_latent(self.value, latent, **options)
        target = with_members(tensordict.get(keys.reward_to_go), value, "OfflineValueLoss")
        return {"loss_value": (value - target).square().mean()}


class TD1ValueLoss(LaggedTargetLoss):
    """J(θ) = (V_θ(z_t) − (r_t + γ V_θ'(z_{t+1})))² with a lagged target θ' (equation (4)).

    No ``done`` mask: episodes end only by the horizon (section 1.1.1). Each member bootstraps from its own
    lagged copy. Couple it with ``HardUpdate(loss, value_network_update_interval=99)`` for a copy every 100
    updates.

    Args:
        value: any module of the latent whose first output is the value ``[*B, 1]``, or ``[*B, M, 1]`` of M members.
        gamma: γ in [0, 1] (Table 1: 0.99).
        zero_at_goal: the target is 0 where the reward is 0, since the agent may stay in the goal set; this is
            what the authors' code does.
        bootstrap: the batch is ``[B, M]`` and member m learns from column m alone; the value must be an ensemble.

    Returns:
        The scalar ``loss_value``.

    Raises:
        TypeError: for ``bootstrap`` without an ensemble.
        ValueError: for γ outside [0, 1], a bootstrap batch without M columns, or values and targets that do not fit.
        KeyError: when a key is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import ValueEnsemble
        >>> from torchrl.objectives import HardUpdate
        >>> loss = TD1ValueLoss(ValueEnsemble(8))
        >>> updater = HardUpdate(loss, value_network_update_interval=99)
        >>> next_step = {"latent": torch.zeros(4, 8), "reward": -torch.ones(4, 1)}
        >>> batch = TensorDict({"latent": torch.zeros(4, 8), "next": next_step}, [4])
        >>> loss(batch)["loss_value"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            latent (NestedKey): z_t.
            next_latent (NestedKey): z_{t+1}.
            reward (NestedKey): r_t, the reward of the step from t.
            lagged_value_target (NestedKey): what V_θ(z_t) is compared with; computed where a batch lacks it.
        """

        latent: NestedKey = "latent"
        next_latent: NestedKey = ("next", "latent")
        reward: NestedKey = ("next", "reward")
        lagged_value_target: NestedKey = "lagged_value_target"

    target_name, lagged = "lagged_value_target", "value"
    value: TensorDictModuleBase
    value_params: TensorDictParams
    target_value_params: TensorDictParams

    def __init__(
        self,
        value: TensorDictModuleBase,
        *,
        gamma: float = 0.99,
        zero_at_goal: bool = True,
        bootstrap: bool = False,
    ) -> None:
        super().__init__()
        if bootstrap:
            require_ensemble(value, "TD1ValueLoss")
        self.convert_to_functional(value, "value", create_target_params=True)
        self.out_keys = ["loss_value"]
        self.gamma = require_unit_interval(gamma, "gamma")
        self.zero_at_goal = zero_at_goal
        self.bootstrap = bootstrap
        self._optional = frozenset({"lagged_value_target"})

    def _values(self, latent: Tensor, which: str) -> Tensor:
        options = {"per_member": True} if self.bootstrap else {}
        return call_on_latent(self.value, latent, params=self._weights(which), **options)

    def target(self, next_latent: Tensor, reward: Tensor) -> Tensor:
        """r_t + γ V_θ'(z_{t+1}), ``[B, 1]``, or ``[B, M, 1]`` of every member."""
        with torch.no_grad():
            next_value = self._values(next_latent, "target_value")
        reward = with_members(reward, next_value, "TD1ValueLoss").expand_as(next_value)
        never = torch.zeros_like(reward, dtype=torch.bool)
        target = td0_return_estimate(self.gamma, next_value, reward, terminated=never)
        return torch.where(reward == 0, torch.zeros_like(target), target) if self.zero_at_goal else target

    def targets(self, tensordict: TensorDictBase) -> Tensor:
        """:meth:`target` of transitions."""
        keys = self.tensor_keys
        return self.target(tensordict.get(keys.next_latent), tensordict.get(keys.reward))

    @property
    def target_settings(self) -> tuple[float, ...]:
        """γ, and which targets are changed."""
        return self.gamma, self.zero_at_goal

    @property
    def has_targets_by_row(self) -> bool:
        """Whether the value is an ensemble of this library, and nobody else is told when it is called."""
        value = self.value
        ours = type(self) is TD1ValueLoss and type(value) is ValueEnsemble and type(value.network) is EnsembleMLP
        return ours and not any(is_hooked(part) for part in self.value.modules())

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The loss on transitions ``[B]``, or ``[B, M]`` with ``bootstrap``."""
        latent = tensordict.get(self.tensor_keys.latent)
        if self.bootstrap:
            check_members(latent, self.value, "TD1ValueLoss")
        target = self.given_or_computed_targets(tensordict)
        value = self._values(latent, "value")
        target = with_members(target, value, "TD1ValueLoss")
        return {"loss_value": (value - target).square().mean()}
