"""Equation (2): the probabilistic dynamics' negative log-likelihood."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey, TensorDictBase
from torch.distributions import Normal
from torchrl.objectives import LossModule

from ls3_torchrl._checks import require_at_least, require_keys
from ls3_torchrl.modules.dynamics import EnsembleDynamics
from ls3_torchrl.objectives._common import as_scalars, check_members


class EnsembleDynamicsLoss(LossModule):
    """J(θ) = −log f_dyn,θ(z' | z, a), averaged over batch, members and latent dimensions (equation (2)).

    Averaging over the D dimensions instead of summing them only scales the gradient, which Adam undoes.

    Args:
        dynamics: the ensemble.
        bootstrap: the batch is ``[B, M]`` and member m learns from column m alone, as in Chua et al.;
            otherwise it is ``[B]`` and every member sees all of it.
        steps: K, the paper's is 1. With more, the batch has K transitions of one episode behind, ``[B, K]`` or
            ``[B, M, K]``, and every member's mean is carried on over them: what one step hardly shows, such as the
            effect of a torque, shows over several.

    Returns:
        Scalars ``loss_dynamics`` and, detached, ``prediction_error`` (mean squared error of the means).

    Raises:
        ValueError: when a bootstrap batch has not M columns.
        KeyError: when a key is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import EnsembleDynamics
        >>> loss = EnsembleDynamicsLoss(EnsembleDynamics(8, 2))
        >>> z = torch.zeros(4, 8)
        >>> batch = TensorDict({"latent": z, "action": torch.zeros(4, 2), "next": {"latent": z}}, [4])
        >>> loss(batch)["loss_dynamics"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            latent (NestedKey): z_t.
            action (NestedKey): a_t.
            next_latent (NestedKey): z_{t+1}.
        """

        latent: NestedKey = "latent"
        action: NestedKey = "action"
        next_latent: NestedKey = ("next", "latent")

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    dynamics: EnsembleDynamics

    def __init__(self, dynamics: EnsembleDynamics, *, bootstrap: bool = False, steps: int = 1) -> None:
        super().__init__()
        self.steps = require_at_least(steps, 1, "steps")
        self.out_keys = ["loss_dynamics", "prediction_error"]
        self.dynamics = dynamics
        self.bootstrap = bootstrap

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys that are read, as ``set_keys`` left them."""
        keys = self.tensor_keys
        return [keys.latent, keys.action, keys.next_latent]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        pass

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss on transitions ``[B]``, or ``[B, M]`` with ``bootstrap``, or either with ``steps`` behind."""
        keys = self.tensor_keys
        require_keys(tensordict, self.in_keys, "EnsembleDynamicsLoss")
        latent, action, target = (tensordict.get(key) for key in (keys.latent, keys.action, keys.next_latent))
        first = latent
        if self.steps > 1:
            if latent.ndim < 3 or latent.shape[-2] != self.steps:
                raise ValueError(
                    f"EnsembleDynamicsLoss(steps={self.steps}) needs stretches, latents of shape [B, {self.steps}, D] "
                    f"with members before them if bootstrap, got {list(latent.shape)}. Sample with steps={self.steps}."
                )
            first = latent[..., 0, :]
        if self.bootstrap:
            check_members(first, self.dynamics.num_members, "EnsembleDynamicsLoss")
        else:
            target = target.unsqueeze(-2 if self.steps == 1 else -3)
        predict = self.dynamics.distribution if self.steps == 1 else self.dynamics.unroll
        loc, scale = predict(first, action, per_member=self.bootstrap)
        target = target.expand_as(loc)
        return as_scalars(
            # Unchecked: the checks of the arguments take longer than the density.
            loss_dynamics=-Normal(loc, scale, validate_args=False).log_prob(target).mean(),
            prediction_error=(loc.detach() - target).square().mean(),
        )
