"""Probabilistic ensemble dynamics f_dyn over latents (equation (2); Chua et al., 2018)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ls3_torchrl._checks import require_keys, require_size
from ls3_torchrl.modules.ensemble import EnsembleMLP


class EnsembleDynamics(TensorDictModuleBase):
    """M networks, each a Gaussian over the next latent: N(z + Δ_m(z, a), σ_m(z, a)²).

    Two hidden layers of 128 (section 1.1.1). ``forward`` imagines one step: every row, a particle, is moved by one
    member, sampled anew at every step (TS-1, the paper's choice), and its noise. Members and noise that are already in
    the tensordict are used as they are, which makes rollouts repeatable.

    The mean change Δ_m and the standard deviation σ_m come from one network of latent and action together, which is the
    paper's choice. With ``control_affine`` the network sees the latent alone, and Δ_m(z, a) = b_m(z) + A_m(z) a with
    σ_m(z). Most mechanics have this form, and few demonstrations then tell what actions do that they hardly contain.

    Args:
        latent_dim: D.
        action_dim: A.
        num_members: M.
        hidden: sizes of the hidden layers.
        control_affine: the change of the latent is affine in the action.
        action_scale: unit of the actions, one number or one for each of A; the networks see a / ``action_scale``. Half
            the action's range is a good one: a displacement of centimetres in metres is all but invisible to them.
        log_scale_bounds: range that the log standard deviation is clamped to. Outside it the gradient is that of the
            soft bounds of Chua et al., at most one half: a network that has left the range can come back.
        latent_key: latent ``[*B, D]``.
        action_key: action ``[*B, A]``, in the environment's units.
        next_latent_key: where the imagined next latent ``[*B, D]`` is written.
        member_key: member of each row, int64 ``[*B, 1]`` in 0…M−1; sampled when absent.
        noise_key: standard normal noise ``[*B, D]``; sampled when absent.

    Raises:
        ValueError: for an ``action_scale`` that is not positive or not of size A, or latents and actions of another
            size.
        KeyError: when latent or action is missing.

    Source: Chua et al., "Deep Reinforcement Learning in a Handful of Trials", section 5 and appendix.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> dynamics = EnsembleDynamics(latent_dim=8, action_dim=2)
        >>> td = TensorDict({"latent": torch.zeros(4, 8), "action": torch.zeros(4, 2)}, [4])
        >>> dynamics(td)["next", "latent"].shape
        torch.Size([4, 8])
    """

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        *,
        num_members: int = 5,
        hidden: Sequence[int] = (128, 128),
        control_affine: bool = False,
        action_scale: float | Sequence[float] = 1.0,
        log_scale_bounds: tuple[float, float] = (-8.0, 4.0),
        latent_key: NestedKey = "latent",
        action_key: NestedKey = "action",
        next_latent_key: NestedKey = ("next", "latent"),
        member_key: NestedKey = "dynamics_member",
        noise_key: NestedKey = "dynamics_noise",
    ) -> None:
        super().__init__()
        low, high = log_scale_bounds
        if not low < high:
            raise ValueError(f"log_scale_bounds must rise, got {log_scale_bounds}.")
        self.latent_dim, self.action_dim, self.num_members = latent_dim, action_dim, num_members
        self.control_affine = control_affine
        self.log_scale_bounds = (float(low), float(high))
        scale = torch.as_tensor(action_scale, dtype=torch.float32)
        if scale.ndim > 1 or scale.numel() not in (1, action_dim) or not (scale > 0).all():
            raise ValueError(
                f"action_scale must be one positive number or one for each of {action_dim} actions, got {action_scale}."
            )
        self.register_buffer("action_scale", scale, persistent=False)
        self.in_keys = [latent_key, action_key]
        self.out_keys = [next_latent_key]
        self.member_key, self.noise_key = member_key, noise_key
        sizes = (
            (latent_dim, (2 + action_dim) * latent_dim) if control_affine else (latent_dim + action_dim, 2 * latent_dim)
        )
        self.network = EnsembleMLP(*sizes, num_members=num_members, hidden=hidden)

    def network_input(self, latent: Tensor, action: Tensor) -> Tensor:
        """What the network sees of a latent ``[*B, D]`` and an action ``[*B, A]``."""
        require_size(latent, self.latent_dim, self.in_keys[0], "EnsembleDynamics")
        require_size(action, self.action_dim, self.in_keys[1], "EnsembleDynamics")
        return latent if self.control_affine else torch.cat([latent, action / self.action_scale], -1)

    def read_output(self, output: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The mean change of the latent and its log standard deviation, each ``[*B, D]``.

        Args:
            output: what the network wrote, ``[*B, 2 D]``; b, log σ and the rows of A, ``[*B, (2 + A) D]``, if
                ``control_affine``.
            action: ``[*B, A]``.
        """
        if not self.control_affine:
            delta, log_scale = output.chunk(2, -1)
        else:
            drift, log_scale, gain = output.split(
                [self.latent_dim, self.latent_dim, self.latent_dim * self.action_dim], -1
            )
            unit = (action / self.action_scale).unsqueeze(-2)
            delta = drift + (gain.unflatten(-1, (self.latent_dim, self.action_dim)) * unit).sum(-1)
        return delta, _clamp(log_scale, *self.log_scale_bounds)

    def distribution(self, latent: Tensor, action: Tensor, *, per_member: bool = False) -> tuple[Tensor, Tensor]:
        """Every member's mean and standard deviation of the next latent.

        Args:
            latent: ``[*B, D]``, or ``[*B, M, D]`` with ``per_member``.
            action: ``[*B, A]``, or ``[*B, M, A]`` with ``per_member``.
            per_member: member m sees column m of the last batch dimension.

        Returns:
            Mean and standard deviation, each ``[*B, M, D]``.
        """
        output = self.network(self.network_input(latent, action), per_member=per_member)
        if not per_member:
            latent, action = latent.unsqueeze(-2), action.unsqueeze(-2)
        delta, log_scale = self.read_output(output, action)
        return latent + delta, log_scale.exp()

    def unroll(self, latent: Tensor, actions: Tensor, *, per_member: bool = False) -> tuple[Tensor, Tensor]:
        """Every member's means and standard deviations over K steps, starting each step from its own last mean.

        Args:
            latent: ``[*B, D]``, or ``[*B, M, D]`` with ``per_member``.
            actions: ``[*B, K, A]``, or ``[*B, M, K, A]`` with ``per_member``.
            per_member: member m sees column m of the last batch dimension.

        Returns:
            Means and standard deviations, each ``[*B, M, K, D]``.
        """
        if not per_member:
            latent = latent.unsqueeze(-2).expand(*latent.shape[:-1], self.num_members, -1)
            actions = actions.unsqueeze(-3).expand(*actions.shape[:-2], self.num_members, -1, -1)
        means, scales = [], []
        for action in actions.unbind(-2):
            latent, scale = self.distribution(latent, action, per_member=True)
            means.append(latent)
            scales.append(scale)
        return torch.stack(means, -2), torch.stack(scales, -2)

    def sample_members(self, num_rows: int, *, device: torch.device | None = None) -> Tensor:
        """Members for ``num_rows`` particles, int64 ``[num_rows]``: as even a split as can be, in random order."""
        order = torch.randperm(num_rows, device=device) % self.num_members
        return torch.randperm(self.num_members, device=device)[order]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Move every row by one member and write the next latent."""
        require_keys(tensordict, self.in_keys, "EnsembleDynamics")
        latent, action = (tensordict.get(key) for key in self.in_keys)
        members = tensordict.get(self.member_key, None)
        if members is None:
            members = self.sample_members(latent[..., 0].numel(), device=latent.device)
            members = members.reshape(*latent.shape[:-1], 1)
        noise = tensordict.get(self.noise_key, None)
        if noise is None:
            noise = torch.randn_like(latent)
        loc, scale = self.distribution(latent, action)
        index = members.unsqueeze(-1).expand(*members.shape, self.latent_dim)
        chosen = [value.gather(-2, index).squeeze(-2) for value in (loc, scale)]
        return tensordict.set(self.out_keys[0], chosen[0] + chosen[1] * noise)


def _clamp(x: Tensor, low: float, high: float) -> Tensor:
    if torch.is_grad_enabled() and x.requires_grad:
        return _SoftBackward.apply(x, low, high)
    return x.clamp(low, high)


class _SoftBackward(torch.autograd.Function):
    """Values clamped; outside the range the gradient of high − softplus(high − x) and low + softplus(x − low)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, low: float, high: float) -> Tensor:
        clamped = x.clamp(low, high)
        ctx.save_for_backward(x, clamped)
        return clamped

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        x, clamped = ctx.saved_tensors
        outside = (x - clamped).abs()
        return torch.where(outside > 0, grad * torch.sigmoid(-outside), grad), None, None
