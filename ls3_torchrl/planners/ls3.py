"""LS3Planner: the whole of LS³'s control, as a TorchRL policy."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import InteractionType, TensorDictModuleBase, set_interaction_type
from torch import Tensor
from torchrl.envs import TensorDictPrimer
from torchrl.modules.planners import MPCPlannerBase

from ls3_torchrl._checks import (
    require_at_least,
    require_choice,
    require_finite,
    require_keys,
    require_probability,
)
from ls3_torchrl.modules.classifiers import LatentClassifier
from ls3_torchrl.modules.value import ValueEnsemble
from ls3_torchrl.planners.cem import CEMResult, CrossEntropyMethod, PlanScores
from ls3_torchrl.planners.fused import FusedImagination
from ls3_torchrl.planners.imagination import (
    Imagination,
    ImaginationNoise,
    Limits,
    PlanNoise,
    RolloutImagination,
    draw_members,
)
from ls3_torchrl.planners.latent_env import LatentEnv
from ls3_torchrl.planners.layers import Precision
from ls3_torchrl.planners.scoring import (
    ConstraintReduction,
    GoalReduction,
    PlanStatistics,
    SafeSetReduction,
    feasible,
    least_harm,
    objective,
)
from ls3_torchrl.planners.warm_start import WarmStart

Engine = Literal["auto", "fused", "rollout"]


class LS3Planner(MPCPlannerBase):
    """Model predictive control inside the safe set (section 1.1.1, "Cross Entropy Method").

    Maximises E[V(z_H)] + imagined steps in the goal, subject to f_C ≤ δ_C at every imagined step and
    f_S(z_H) ≥ δ_S. A row in which no plan of a round is feasible multiplies its δ_S by ``relaxation`` and
    starts again. When the relaxations are used up, it acts on the plan with the fewest predicted violations
    and the safest end, never at random, and says so under ``("plan", "fallback")``.

    Plans for all rows of a batch at once, each with its own δ_S, warm start and reset. Use it as the policy
    of any collector or ``rollout``; with ``p_random`` below 1 append :meth:`primer` and an ``InitTracker`` to
    the environment, so that the last plan is carried to the next step and dropped at a reset.

    Args:
        env: the learned model.
        value: V.
        safe_set: f_S.
        encoder: module from observations to ``latent``; the mean of a posterior is used. ``None`` when the
            tensordict holds the latent already.
        horizon: H, imagined steps.
        num_candidates: N.
        num_elites: sequences that the Gaussian is refitted on, 1 to N.
        num_particles: P, imagined outcomes of each plan.
        optim_steps: scored rounds. Table 1's n_cem_iters = 5 samples five iterations and scores four.
        safe_set_threshold: initial δ_S, a probability strictly between 0 and 1.
        constraint_threshold: δ_C, likewise.
        relaxation: factor on δ_S when nothing is feasible, strictly between 0 and 1.
        max_relaxations: how often δ_S may be relaxed in one plan.
        p_random: share of uniform candidates in the first round; the rest are drawn round the last plan.
        p_constant: share of candidates in the first round that hold one uniform action over the horizon.
        constraint_reduction: over particles, ``"max"`` as the authors' code or ``"mean"``.
        safe_set_reduction: over particles, ``"mean"`` as the authors' code or ``"min"``: every particle must end
            in the safe set. A mean of δ_S lets a share 1 − δ_S of the particles end anywhere, and a plan gains from
            sending them where the value is overestimated.
        goal_reduction: over imagined steps, ``"count"`` of those that are more likely in the goal than not, as the
            authors' code, or ``"expected"``, the sum of the probabilities.
        pessimism: κ ≥ 0, subtracts κ standard deviations over the value ensemble; 0 is the paper.
        common_noise: judge all candidates of a row by the same particles (common random numbers), which
            compares them with less variance; ``False`` draws noise for each.
        noise_scale: factor on the dynamics' learnt standard deviation, at least 0; 1 is the paper. With 0 the
            particles differ by their members alone. Where latents are samples of wide posteriors, most of that
            deviation is the posteriors' own, and with few particles it drowns what tells one plan from another.
        min_std: floor of the refitted standard deviation, a share of the action box's side.
        engine: ``"fused"`` runs a snapshot of the networks, ``"rollout"`` runs ``LatentEnv.rollout`` and takes
            any modules, ``"auto"`` the first where it can.
        precision: of the fused engine.
        action_key: where the action ``[*B, A]`` is written.
        latent_key: where the encoder writes the latent.
        plan_key: group under which the plan is described.
        is_init_key: bool ``[*B, 1]``, the first step of an episode; optional.

    Returns:
        From the call: the tensordict with ``action``, and under ``plan`` ``feasible``, ``fallback``,
        ``safe_set_threshold`` (the δ_S acted on), ``score``, ``iterations``, all ``[*B, 1]``; under
        ``("next", "plan")`` the warm start ``mean`` and ``std`` ``[*B, H, A]``.

    Raises:
        ValueError: for settings out of range; by the call, for an observation that is not finite.
        KeyError: by the call, when the encoder's input is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator, SafeSet
        >>> from ls3_torchrl.modules import ValueEnsemble
        >>> spec = Bounded(low=-1.0, high=1.0, shape=(2,))
        >>> env = LatentEnv(EnsembleDynamics(8, 2), ConstraintEstimator(8), GoalEstimator(8), action_spec=spec)
        >>> planner = LS3Planner(env, ValueEnsemble(8), SafeSet(8), num_candidates=50, num_elites=5)
        >>> planner(TensorDict({"latent": torch.zeros(3, 8)}, [3]))["action"].shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        env: LatentEnv,
        value: ValueEnsemble,
        safe_set: LatentClassifier,
        encoder: TensorDictModuleBase | None = None,
        *,
        horizon: int = 5,
        num_candidates: int = 1000,
        num_elites: int = 100,
        num_particles: int = 20,
        optim_steps: int = 4,
        safe_set_threshold: float = 0.8,
        constraint_threshold: float = 0.2,
        relaxation: float = 0.8,
        max_relaxations: int = 5,
        p_random: float = 1.0,
        p_constant: float = 0.0,
        constraint_reduction: ConstraintReduction = "max",
        safe_set_reduction: SafeSetReduction = "mean",
        goal_reduction: GoalReduction = "count",
        pessimism: float = 0.0,
        common_noise: bool = True,
        noise_scale: float = 1.0,
        min_std: float = 0.0,
        engine: Engine = "auto",
        precision: Precision = "auto",
        action_key: NestedKey = "action",
        latent_key: NestedKey = "latent",
        plan_key: NestedKey = "plan",
        is_init_key: NestedKey = "is_init",
    ) -> None:
        super().__init__(env, action_key=action_key)
        self.horizon = require_at_least(horizon, 1, "horizon")
        self.num_particles = require_at_least(num_particles, 1, "num_particles")
        self.safe_set_threshold = require_probability(safe_set_threshold, "safe_set_threshold")
        self.constraint_threshold = require_probability(constraint_threshold, "constraint_threshold")
        self.relaxation = require_probability(relaxation, "relaxation")
        require_choice(constraint_reduction, ("max", "mean"), "constraint_reduction")
        require_choice(safe_set_reduction, ("mean", "min"), "safe_set_reduction")
        reductions: dict[str, Any] = {
            "constraint_reduction": constraint_reduction,
            "safe_set_reduction": safe_set_reduction,
        }
        require_choice(engine, ("auto", "fused", "rollout"), "engine")
        if pessimism < 0.0:
            raise ValueError(f"pessimism must not be negative, got {pessimism}.")
        if noise_scale < 0.0:
            raise ValueError(f"noise_scale must not be negative, got {noise_scale}.")
        require_choice(goal_reduction, ("count", "expected"), "goal_reduction")
        self.goal_reduction: GoalReduction = goal_reduction
        self.pessimism = pessimism
        self.noise_scale = noise_scale
        self.common_noise = common_noise
        self.cem = CrossEntropyMethod(
            num_candidates=num_candidates,
            num_elites=num_elites,
            optim_steps=optim_steps,
            max_restarts=max_relaxations,
            p_random=p_random,
            p_constant=p_constant,
            min_std=min_std,
        )
        self.value, self.safe_set, self.encoder = value, safe_set, encoder
        self.imagine: Imagination
        if engine == "fused" or (engine == "auto" and FusedImagination.supports(env, value, safe_set)):
            self.imagine = FusedImagination(env, value, safe_set, precision=precision, **reductions)
        else:
            self.imagine = RolloutImagination(env, value, safe_set, **reductions)
        self.action_key, self.latent_key = action_key, latent_key
        self.plan_key = plan_key
        space = self.action_spec.space
        self.warm_start = WarmStart(space.low, space.high, horizon, plan_key, is_init_key)
        self.in_keys = [latent_key] if encoder is None else list(encoder.in_keys)
        self.out_keys = [action_key, *(self._plan(name) for name in _DECISIONS)]

    def _plan(self, name: str) -> NestedKey:
        return unravel_key((self.plan_key, name))

    def primer(self) -> TensorDictPrimer:
        """The transform that carries the warm start from step to step and resets it with the episode."""
        return self.warm_start.primer()

    def draw_noise(self, batch: int) -> PlanNoise:
        """All noise that a plan for ``batch`` rows can need; large, meant for tests and comparisons."""
        device, rows = self.action_spec.device, torch.arange(batch, device=self.action_spec.device)
        draws = [
            (*self._draw_candidates(rows, k), *self._draw_imagination(rows, k)) for k in range(self.cem.max_iterations)
        ]
        return PlanNoise(*(torch.stack(parts).to(device) for parts in zip(*draws, strict=True)))

    def _draw_candidates(self, rows: Tensor, iteration: int) -> tuple[Tensor, Tensor]:
        return self.cem.draw(rows, self.horizon, self.action_spec.shape[-1])

    def _draw_imagination(self, rows: Tensor, iteration: int) -> ImaginationNoise:
        dynamics = self.env.dynamics
        fixed = dynamics.propagation == "tsinf"
        candidates = 1 if self.common_noise else self.cem.num_candidates
        shape = (rows.numel(), self.horizon, self.num_particles, candidates, dynamics.latent_dim)
        members = draw_members(dynamics.num_members, self.horizon, self.num_particles, fixed=fixed, device=rows.device)
        return ImaginationNoise(members, self.noise_scale * torch.randn(shape, device=rows.device))

    def encode(self, tensordict: TensorDictBase) -> Tensor:
        """The latent ``[*B, D]`` to plan from."""
        require_keys(tensordict, self.in_keys, "LS3Planner")
        if self.encoder is None:
            latent = tensordict.get(self.latent_key)
        else:
            for key in self.in_keys:
                require_finite(tensordict.get(key), f"The observation {key!r}")
            with set_interaction_type(InteractionType.DETERMINISTIC):
                latent = self.encoder(tensordict.select(*self.in_keys)).get(self.latent_key)
        require_finite(latent, "The latent to plan from")
        return latent

    def score_plans(self, statistics: PlanStatistics, threshold: Tensor) -> PlanScores:
        """Objective, feasibility and fallback ranking of candidates under δ_S ``[b, 1]``."""
        return PlanScores(
            objective(statistics, pessimism=self.pessimism, goal_reduction=self.goal_reduction),
            feasible(statistics, safe_set_threshold=threshold, constraint_threshold=self.constraint_threshold),
            least_harm(statistics, constraint_threshold=self.constraint_threshold),
        )

    @torch.no_grad()
    def plan(
        self,
        latent: Tensor,
        mean: Tensor | None = None,
        std: Tensor | None = None,
        noise: PlanNoise | None = None,
    ) -> CEMResult:
        """Plan from latents, the tensors' way.

        Args:
            latent: ``[B, D]``.
            mean: mean of the first round's Gaussian, ``[B, H, A]``.
            std: its standard deviation.
            noise: all randomness; drawn when ``None``.
        """
        space = self.action_spec.space

        def score(actions: Tensor, rows: Tensor, restarts: Tensor, iteration: int) -> PlanScores:
            if noise is None:
                drawn = self._draw_imagination(rows, iteration)
            else:
                drawn = ImaginationNoise(noise.members[iteration], noise.dynamics[iteration][rows])
            threshold = self._threshold(restarts).unsqueeze(-1)
            limits = Limits(threshold, self.constraint_threshold)
            return self.score_plans(self.imagine(latent[rows], actions, drawn, limits), threshold)

        def candidates(rows: Tensor, iteration: int) -> tuple[Tensor, Tensor]:
            if noise is None:
                return self._draw_candidates(rows, iteration)
            return noise.normal[iteration][rows], noise.uniform[iteration][rows]

        with self.imagine.parameters_fixed():
            return self.cem(
                score,
                space.low,
                space.high,
                batch=latent.shape[0],
                horizon=self.horizon,
                mean=mean,
                std=std,
                noise=candidates,
            )

    def _threshold(self, restarts: Tensor) -> Tensor:
        return self.safe_set_threshold * self.relaxation ** restarts.to(torch.float32)

    def planning(self, td: TensorDictBase, noise: PlanNoise | None = None) -> Tensor:
        """The actions ``[*B, A]`` alone, as TorchRL's planners return them."""
        return self(td.copy(), noise=noise).get(self.action_key)

    def forward(
        self,
        tensordict: TensorDictBase,
        tensordict_out: TensorDictBase | None = None,
        *,
        noise: PlanNoise | None = None,
    ) -> TensorDictBase:
        """Plan for every row and write action, decisions and the next step's warm start."""
        out = tensordict if tensordict_out is None else tensordict_out
        latent = self.encode(tensordict)
        batch = latent.shape[:-1]
        rows = batch.numel()
        mean, std = self.warm_start.read(tensordict, rows)
        result = self.plan(latent.reshape(rows, -1), mean, std, noise)

        decisions = {
            "feasible": ~result.fallback,
            "fallback": result.fallback,
            "safe_set_threshold": self._threshold(result.restarts),
            "score": result.score,
            "iterations": result.iterations,
        }
        out.set(self.action_key, result.actions[:, 0].reshape(*batch, -1))
        for name, value in decisions.items():
            out.set(self._plan(name), value.reshape(*batch, 1))
        self.warm_start.write(out, result.mean, result.std)
        return out

    def statistics(self, latent: Tensor, actions: Tensor) -> PlanStatistics:
        """What the planner imagines of given plans ``[B, N, H, A]`` from latents ``[B, D]``, for pictures."""
        rows = torch.arange(latent.shape[0], device=latent.device)
        candidates = 1 if self.common_noise else actions.shape[1]
        noise = self._draw_imagination(rows, 0)
        return self.imagine(latent, actions, ImaginationNoise(noise.members, noise.noise[:, :, :, :candidates]))


_DECISIONS = ("feasible", "fallback", "safe_set_threshold", "score", "iterations")


def describe_plan(tensordict: TensorDictBase, plan_key: NestedKey = "plan") -> TensorDict:
    """Shares of steps over a collected batch: how often plans were feasible, relaxed, or a fallback.

    Args:
        tensordict: what a rollout with the planner returned.
        plan_key: the planner's group.

    Returns:
        Scalars ``fallback_rate``, ``relaxed_rate`` and ``iterations``.
    """
    plan = tensordict.get(plan_key)
    threshold = plan["safe_set_threshold"]
    return TensorDict(
        {
            "fallback_rate": plan["fallback"].float().mean(),
            "relaxed_rate": (threshold < threshold.amax() - 1e-6).float().mean(),
            "iterations": plan["iterations"].float().mean(),
        }
    )
