"""Equation (2): the probabilistic dynamics' negative log-likelihood."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.distributions import Normal

from ls3_torchrl._checks import require_at_least
from ls3_torchrl.objectives.base import LatentLoss, check_members, require_ensemble, with_members


class EnsembleDynamicsLoss(LatentLoss):
    """J(θ) = −log f_dyn,θ(z' | z, a), averaged over batch, members and latent dimensions (equation (2)).

    Averaging over the D dimensions instead of summing them only scales the gradient, which Adam undoes.

    Args:
        dynamics: :class:`~ls3_torchrl.modules.EnsembleDynamics`, or a module with a method ``distribution`` from
            latents ``[*B, D]`` and actions ``[*B, A]`` to mean and standard deviation of the next latents, ``[*B, D]``
            or ``[*B, M, D]``; for ``steps`` above 1 with a method ``unroll``, for ``bootstrap`` with ``num_members``
            and an argument ``per_member``, as the ensemble has them.
        bootstrap: the batch is ``[B, M]`` and member m learns from column m alone, as in Chua et al.;
            otherwise it is ``[B]`` and every member sees all of it.
        steps: K, the paper's is 1. With more, the batch has K transitions of one episode behind, ``[B, K]`` or
            ``[B, M, K]``, over which every member is unrolled from its own means: what one step hardly shows, such as
            the effect of a torque, shows over several.

    Returns:
        Scalars ``loss_dynamics`` and, detached, ``prediction_error`` (mean squared error of the means).

    Raises:
        TypeError: for dynamics that lack one of these methods.
        ValueError: when a bootstrap batch has not M columns, or the batch not K steps.
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

    dynamics: TensorDictModuleBase

    def __init__(self, dynamics: TensorDictModuleBase, *, bootstrap: bool = False, steps: int = 1) -> None:
        super().__init__()
        self.steps = require_at_least(steps, 1, "steps")
        self._predict = "distribution" if steps == 1 else "unroll"
        if not hasattr(dynamics, self._predict):
            raise TypeError(
                f"EnsembleDynamicsLoss(steps={steps}) needs dynamics with a method {self._predict}(latent, action) for "
                f"mean and standard deviation of the next latents; {type(dynamics).__name__} has none. Add the method, "
                "or train with LatentPredictionLoss, which only needs the next latent."
            )
        if bootstrap:
            require_ensemble(dynamics, "EnsembleDynamicsLoss")
        self.out_keys = ["loss_dynamics", "prediction_error"]
        self.dynamics = dynamics
        self.bootstrap = bootstrap

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The loss on transitions ``[B]``, or ``[B, M]`` with ``bootstrap``, or either with ``steps`` behind."""
        keys = self.tensor_keys
        latent, action, target = (tensordict.get(key) for key in (keys.latent, keys.action, keys.next_latent))
        if self.steps > 1:
            if latent.ndim < 3 or latent.shape[-2] != self.steps:
                raise ValueError(
                    f"EnsembleDynamicsLoss(steps={self.steps}) needs stretches, latents of shape [B, {self.steps}, D] "
                    f"with members before them if bootstrap, got {list(latent.shape)}. Sample with steps={self.steps}."
                )
            latent = latent[..., 0, :]
        if self.bootstrap:
            check_members(latent, self.dynamics, "EnsembleDynamicsLoss")
        options = {"per_member": True} if self.bootstrap else {}
        loc, scale = getattr(self.dynamics, self._predict)(latent, action, **options)
        target = with_members(target, loc, "EnsembleDynamicsLoss", trailing=1 if self.steps == 1 else 2).expand_as(loc)
        return {
            # Unchecked: the checks of the arguments take longer than the density.
            "loss_dynamics": -Normal(loc, scale, validate_args=False).log_prob(target).mean(),
            "prediction_error": (loc.detach() - target).square().mean(),
        }
