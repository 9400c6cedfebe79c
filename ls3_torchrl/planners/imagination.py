"""Imagining candidate plans: the plain way, through LatentEnv, and what every way needs."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import NamedTuple, Protocol

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ls3_torchrl.modules.call import call_on_latent
from ls3_torchrl.modules.classifiers import probability_of
from ls3_torchrl.options.planner import SafeSetReduction
from ls3_torchrl.planners.latent_env import LatentEnv
from ls3_torchrl.planners.scoring import PlanStatistics


class ImaginationNoise(NamedTuple):
    """All randomness of one imagined iteration.

    Attributes:
        members: member that moves particle p at step h, int64 ``[H, P]``; the same for all plans, which
            compares them under common random numbers.
        noise: standard normal ``[b, H, P, D]``, likewise common to a row's candidates.
    """

    members: Tensor
    noise: Tensor


class PlanNoise(NamedTuple):
    """All randomness of a plan over K iterations, for plans that must be repeatable.

    Attributes:
        candidates: the optimiser's noise, each ``[K, B, ...]``; of the cross-entropy method standard normal and
            uniform in [0, 1), ``[K, B, N, H, A]`` each.
        members: dynamics members ``[K, H, P]``.
        dynamics: dynamics noise ``[K, B, H, P, D]``.
    """

    candidates: tuple[Tensor, ...]
    members: Tensor
    dynamics: Tensor

    def row(self, index: int) -> PlanNoise:
        """The noise of one batch row, as a batch of one."""
        one = slice(index, index + 1)
        return PlanNoise(tuple(part[:, one] for part in self.candidates), self.members, self.dynamics[:, one])

    def of_iteration(self, iteration: int, rows: Tensor) -> ImaginationNoise:
        """What rows ``[b]`` are imagined under in one iteration."""
        return ImaginationNoise(self.members[iteration], self.dynamics[iteration][rows])


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


def sample_imagination_noise(
    env: LatentEnv, rows: int, horizon: int, particles: int, *, device: torch.device | None = None
) -> ImaginationNoise:
    """Members and noise for ``rows`` plans: an even split of the particles, anew at each step (TS-1).

    Args:
        env: the learned model; dynamics that are no ensemble have one member.
        rows: b.
        horizon: H.
        particles: P.
        device: where to draw.
    """

    def members() -> Tensor:
        if hasattr(env.dynamics, "sample_members"):
            return env.dynamics.sample_members(particles, device=device)
        return torch.zeros(particles, dtype=torch.long, device=device)

    over_time = torch.stack([members() for _ in range(horizon)])
    return ImaginationNoise(over_time, torch.randn(rows, horizon, particles, env.latent_dim, device=device))


class RolloutImagination:
    """Imagines by ``LatentEnv.rollout``, one tensordict row per particle: plain, slow, for any modules.

    Members and noise are handed to dynamics that have a ``member_key`` and a ``noise_key``; other dynamics draw what
    they need themselves.

    Args:
        env: the learned model.
        value: V; a module of a latent that writes the members' values ``[*B, M, 1]``, or one value ``[*B, 1]``.
        safe_set: f_S; a module of a latent whose first output is a logit ``[*B, 1]``.
        safe_set_reduction: over particles, ``"mean"`` (the authors') or ``"min"``.

    Example:
        >>> from torchrl.data import Bounded
        >>> from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator, SafeSet, ValueEnsemble
        >>> spec = Bounded(low=-1.0, high=1.0, shape=(2,))
        >>> env = LatentEnv(EnsembleDynamics(8, 2), ConstraintEstimator(8), GoalEstimator(8), action_spec=spec)
        >>> imagine = RolloutImagination(env, ValueEnsemble(8), SafeSet(8))
        >>> noise = ImaginationNoise(torch.zeros(3, 4, dtype=torch.long), torch.zeros(1, 3, 4, 8))
        >>> imagine(torch.zeros(1, 8), torch.zeros(1, 6, 3, 2), noise).safe_set_prob.shape
        torch.Size([1, 6])
    """

    def __init__(
        self,
        env: LatentEnv,
        value: TensorDictModuleBase,
        safe_set: TensorDictModuleBase,
        *,
        safe_set_reduction: SafeSetReduction = "mean",
    ) -> None:
        self.env, self.value, self.safe_set = env, value, safe_set
        self.safe_set_reduction = safe_set_reduction

    def parameters_fixed(self) -> AbstractContextManager[None]:
        """Nothing is kept of the parameters here, so nothing can go stale."""
        return nullcontext()

    @torch.no_grad()
    def __call__(
        self, latent: Tensor, actions: Tensor, noise: ImaginationNoise, limits: Limits | None = None
    ) -> PlanStatistics:
        """Statistics of ``actions`` ``[b, N, H, A]`` carried out from ``latent`` ``[b, D]``; all of them, always."""
        path = self._rollout(latent, actions, noise)
        end = path.get(unravel_key(("next", self.env.latent_key)))[..., -1, :]
        value = call_on_latent(self.value, end)
        value = value if value.ndim == end.ndim else value.squeeze(-1)  # one value is one member
        constraint, goal = (
            path.get(unravel_key(("next", key))).squeeze(-1)
            for key in (self.env.constraint_prob_key, self.env.goal_prob_key)
        )
        safe = probability_of(self.safe_set, end).squeeze(-1)
        return PlanStatistics(
            value=value.mean(2).float(),
            goal_prob=goal.mean(2).float(),
            constraint_prob=constraint.amax(2).float(),
            safe_set_prob=(safe.amin(2) if self.safe_set_reduction == "min" else safe.mean(2)).float(),
        )

    def _rollout(self, latent: Tensor, actions: Tensor, noise: ImaginationNoise) -> TensorDictBase:
        """P particles of every plan, ``[b, N, P, H]``."""
        b, n, horizon, _ = actions.shape
        p, d = noise.members.shape[1], latent.shape[-1]
        env, dtype = self.env, self.env.latent_dtype
        member_key, noise_key = (getattr(env.dynamics, name, None) for name in ("member_key", "noise_key"))
        clock = iter(range(horizon))

        def follow_the_plan(tensordict: TensorDictBase) -> TensorDictBase:
            t = next(clock)
            if member_key is not None:
                tensordict.set(member_key, noise.members[t].reshape(1, 1, p, 1).expand(b, n, p, 1))
            if noise_key is not None:
                tensordict.set(noise_key, noise.noise[:, t].unsqueeze(1).expand(b, n, p, d).to(dtype))
            return tensordict.set(env.action_key, actions[:, :, t].unsqueeze(2).expand(b, n, p, -1))

        first = TensorDict({}, [b, n, p])
        first.set(env.latent_key, latent[:, None, None].expand(b, n, p, d).to(dtype))
        start = env.reset(first)
        return env.rollout(horizon, follow_the_plan, auto_reset=False, tensordict=start, return_contiguous=True)
