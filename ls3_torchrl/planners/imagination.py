"""Imagining candidate plans: the plain way, through LatentEnv, and what every way needs."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ls3_torchrl.modules.classifiers import LatentClassifier
from ls3_torchrl.modules.value import ValueEnsemble
from ls3_torchrl.planners.latent_env import LatentEnv
from ls3_torchrl.planners.scoring import ConstraintReduction, PlanStatistics, SafeSetReduction


class ImaginationNoise(NamedTuple):
    """All randomness of one imagined iteration.

    Attributes:
        members: member that moves particle p at step h, int64 ``[H, P]``; the same for all plans, which
            compares them under common random numbers.
        noise: standard normal ``[b, H, P, N or 1, D]``; with 1, common to a row's N candidates.
    """

    members: Tensor
    noise: Tensor


class PlanNoise(NamedTuple):
    """All randomness of a plan over K iterations, for plans that must be repeatable.

    Attributes:
        normal: candidates' Gaussian noise ``[K, B, N, H, A]``.
        uniform: candidates' uniform noise in [0, 1) ``[K, B, N, H, A]``.
        members: dynamics members ``[K, H, P]``.
        dynamics: dynamics noise ``[K, B, H, P, N or 1, D]``.
    """

    normal: Tensor
    uniform: Tensor
    members: Tensor
    dynamics: Tensor

    def row(self, index: int) -> PlanNoise:
        """The noise of one batch row, as a batch of one."""
        one = slice(index, index + 1)
        return PlanNoise(self.normal[:, one], self.uniform[:, one], self.members, self.dynamics[:, one])


class Limits(NamedTuple):
    """What makes a plan feasible.

    Attributes:
        safe_set_threshold: δ_S of each row, ``[b, 1]``.
        constraint_threshold: δ_C.
    """

    safe_set_threshold: Tensor
    constraint_threshold: float


class Imagination(Protocol):
    """Imagines candidate plans and reduces what it sees over the particles."""

    def parameters_fixed(self) -> AbstractContextManager[None]:
        """Within it no parameter changes, so that work on them need be done only once."""

    def __call__(
        self, latent: Tensor, actions: Tensor, noise: ImaginationNoise, limits: Limits | None = None
    ) -> PlanStatistics:
        """Statistics of ``actions`` ``[b, N, H, A]`` carried out from ``latent`` ``[b, D]``.

        With ``limits``, value and goal of infeasible plans may be left out (NaN): nothing depends on them.
        """


def draw_members(num_members: int, horizon: int, particles: int, *, fixed: bool, device: torch.device) -> Tensor:
    """Members ``[H, P]``: an even split in random order, drawn anew at each step, or once if ``fixed`` (TS-∞)."""

    def one() -> Tensor:
        order = torch.randperm(particles, device=device) % num_members
        return torch.randperm(num_members, device=device)[order]

    return one().expand(horizon, -1) if fixed else torch.stack([one() for _ in range(horizon)])


class RolloutImagination:
    """Imagines by ``LatentEnv.rollout``, one tensordict row per particle: plain, slow, for any modules.

    Args:
        env: the learned model.
        value: V.
        safe_set: f_S.
        constraint_reduction: over particles, ``"max"`` (the authors') or ``"mean"``.
        safe_set_reduction: over particles, ``"mean"`` (the authors') or ``"min"``.

    Example:
        >>> from torchrl.data import Bounded
        >>> from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator, SafeSet
        >>> spec = Bounded(low=-1.0, high=1.0, shape=(2,))
        >>> env = LatentEnv(EnsembleDynamics(8, 2), ConstraintEstimator(8), GoalEstimator(8), action_spec=spec)
        >>> imagine = RolloutImagination(env, ValueEnsemble(8), SafeSet(8))
        >>> noise = ImaginationNoise(torch.zeros(3, 4, dtype=torch.long), torch.zeros(1, 3, 4, 1, 8))
        >>> imagine(torch.zeros(1, 8), torch.zeros(1, 6, 3, 2), noise).safe_set_prob.shape
        torch.Size([1, 6])
    """

    def __init__(
        self,
        env: LatentEnv,
        value: ValueEnsemble,
        safe_set: LatentClassifier,
        *,
        constraint_reduction: ConstraintReduction = "max",
        safe_set_reduction: SafeSetReduction = "mean",
    ) -> None:
        self.env, self.value, self.safe_set = env, value, safe_set
        self.constraint_reduction = constraint_reduction
        self.safe_set_reduction = safe_set_reduction

    def parameters_fixed(self) -> AbstractContextManager[None]:
        """Nothing is kept of the parameters here, so nothing can go stale."""
        return nullcontext()

    @torch.no_grad()
    def __call__(
        self, latent: Tensor, actions: Tensor, noise: ImaginationNoise, limits: Limits | None = None
    ) -> PlanStatistics:
        """Statistics of ``actions`` ``[b, N, H, A]`` carried out from ``latent`` ``[b, D]``; all of them, always."""
        b, n, horizon, _ = actions.shape
        p, d = noise.members.shape[1], latent.shape[-1]
        dynamics = self.env.dynamics
        action_key, clock = dynamics.in_keys[1], iter(range(horizon))

        def follow_the_plan(tensordict: TensorDictBase) -> TensorDictBase:
            t = next(clock)
            members = noise.members[t].reshape(1, 1, p, 1).expand(b, n, p, 1)
            step_noise = noise.noise[:, t].transpose(1, 2).expand(b, n, p, d)
            tensordict.set(action_key, actions[:, :, t].unsqueeze(2).expand(b, n, p, -1))
            return tensordict.set(dynamics.member_key, members).set(dynamics.noise_key, step_noise)

        first = TensorDict({"latent": latent[:, None, None].expand(b, n, p, d)}, [b, n, p])
        if dynamics.propagation == "tsinf":
            first.set(dynamics.member_key, noise.members[0].reshape(1, 1, p, 1).expand(b, n, p, 1))
        path = self.env.rollout(
            horizon,
            follow_the_plan,
            auto_reset=False,
            tensordict=self.env.reset(first),
            return_contiguous=True,
        )
        end = path["next", "latent"][..., -1, :]
        ends = TensorDict({self.value.in_keys[0]: end}, [b, n, p])
        value = self.value(ends).get(self.value.out_keys[0]).squeeze(-1)
        constraint = path["next", "constraint_prob"].squeeze(-1)
        safe = self.safe_set.probability(end).squeeze(-1)
        return PlanStatistics(
            value=value.mean(2),
            goal_prob=path["next", "goal_prob"].squeeze(-1).mean(2),
            constraint_prob=constraint.amax(2) if self.constraint_reduction == "max" else constraint.mean(2),
            safe_set_prob=safe.amin(2) if self.safe_set_reduction == "min" else safe.mean(2),
        )
