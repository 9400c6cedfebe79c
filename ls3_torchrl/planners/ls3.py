"""LS3Planner: the whole of LS³'s control, as a TorchRL policy."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import InteractionType, TensorDictModuleBase, set_interaction_type
from torch import Tensor
from torchrl.envs import TensorDictPrimer
from torchrl.modules.planners import MPCPlannerBase

from ls3_torchrl._checks import (
    require_finite,
    require_keys,
    require_module,
)
from ls3_torchrl.modules.call import call_on_latent, posterior_keys
from ls3_torchrl.options.planner import (
    ControlOptions,
    EngineName,
    Precision,
    SafeSetReduction,
)
from ls3_torchrl.planners.cem import optimizer_or_default
from ls3_torchrl.planners.deadline import Deadline
from ls3_torchrl.planners.decisions import Decisions
from ls3_torchrl.planners.engine import Engine
from ls3_torchrl.planners.imagination import (
    Imagination,
    ImaginationNoise,
    Limits,
    PlanNoise,
    sample_imagination_noise,
)
from ls3_torchrl.planners.latent_env import LatentEnv
from ls3_torchrl.planners.optimizer import Optimizer, OptimizerResult, PlanScores
from ls3_torchrl.planners.scoring import (
    PlanStatistics,
    ends_inside,
    feasible,
    least_harm,
    objective,
    require_sound,
)
from ls3_torchrl.planners.warm_start import WarmStart

#: Rates N imagined plans of b rows: (statistics, δ_S ``[b, 1]``, actions ``[b, N, H, A]``, rows ``[b]``) -> scores.
RatePlans = Callable[[PlanStatistics, Tensor, Tensor, Tensor], PlanScores]


class LS3Planner(MPCPlannerBase):
    """Model predictive control inside the safe set (section 1.1.1, "Cross Entropy Method").

    Maximises E[V(z_H)] + imagined steps in the goal, subject to f_C ≤ δ_C at every imagined step and
    f_S(z_H) ≥ δ_S. A row in which no plan of a round ends in the safe set multiplies its δ_S by ``relaxation`` and
    starts again; one in which all such plans violate keeps its δ_S and refits on those that violate least. Where
    nothing feasible was found, it acts on the plan with the fewest predicted violations and the safest end, never at
    random, and says so under ``("plan", "fallback")``.

    All candidates of a row are scored by the same particles, members and noise alike (common random numbers), which
    compares them with less variance.

    Plans for all rows of a batch at once, each with its own δ_S, warm start and reset. Use it as the policy of any
    collector or ``rollout``. An optimiser that starts from the last plan (``p_random`` below 1) needs that plan carried
    from step to step and dropped at a reset: ``Collector(auto_register_policy_transforms=True)`` does so by itself;
    elsewhere append :meth:`make_tensordict_primer` and an ``InitTracker`` to the environment.

    It computes in float32, whatever the dtype of the latents; the action has the dtype of its spec.

    Args:
        model: the learned model.
        value: V; any module of a latent that writes the members' values ``[*B, M, 1]``, or one value ``[*B, 1]``.
        safe_set: f_S; any module of a latent whose first output is a logit ``[*B, 1]``.
        encoder: any module from observations to a latent: it writes ``latent_key``, of which it is asked for the mean,
            or else ``loc``, ``latent`` or a single key. ``None`` when the tensordict holds the latent already.
        optimizer: searches for the best feasible plan; a :class:`~ls3_torchrl.planners.CrossEntropyMethod` when
            ``None``.
        horizon: H, imagined steps.
        num_particles: P, imagined outcomes of each plan.
        safe_set_threshold: initial δ_S, a probability strictly between 0 and 1; ``None`` for plans that may end
            anywhere, and are never relaxed.
        constraint_threshold: δ_C, likewise; ``None`` for plans whatever they violate.
        relaxation: factor on δ_S when no plan ends in the safe set, strictly between 0 and 1.
        max_relaxations: how often δ_S may be relaxed in one plan.
        safe_set_reduction: over particles, ``"mean"`` as the authors' code or ``"min"``: every particle must end
            in the safe set. A mean of δ_S lets a fraction 1 − δ_S of the particles end anywhere, and a plan gains from
            sending them where the value is overestimated.
        noise_scale: factor on the dynamics' learnt standard deviation, at least 0; 1 is the paper. With 0 the
            particles differ by their members alone; above 1 a plan keeps away from a violation by as much as its
            farthest particle strays. Where latents are samples of wide posteriors, most of that
            deviation is the posteriors' own, and with few particles it drowns what tells one plan from another.
        max_ms: milliseconds that a plan may take, the encoder's time with it unless it is compiled; ``None`` for as
            long as the optimiser needs. When no further round fits in, the best feasible plan so far is acted on, or
            else the safest, and ``("plan", "iterations")`` is the smaller. The first round always ends: choose fewer
            candidates where it takes too long by itself. With a limit, plans depend on the speed of the machine.
        engine: ``"fused"`` runs a snapshot of the networks; ``"rollout"`` runs ``LatentEnv.rollout`` and takes
            any modules; ``"auto"`` the first wherever it bypasses no module, which is looked at before each plan.
        precision: of the fused engine.
        action_key: where the action ``[*B, A]`` is written.
        latent_key: where the latent is read, or where the encoder writes it.
        plan_key: group under which the plan is described.
        is_init_key: bool ``[*B, 1]``, the first step of an episode; optional.
        optimizer_settings: of the default optimiser, such as ``num_candidates=200``; see ``CrossEntropyMethod``.

    Returns:
        A call returns the tensordict with ``action``, and under ``plan`` ``feasible``, ``fallback``, ``relaxed``,
        ``safe_set_threshold`` (the δ_S acted on, 0 for none), ``score``, ``iterations``, all ``[*B, 1]``; under
        ``("next", "plan")`` the warm start ``mean`` and ``std`` ``[*B, H, A]``. ``out_keys`` name all of these.
        ``in_keys`` name what is read: the observation, and if the optimiser uses it, the warm start and ``is_init``.
        A tensordict may lack those two, but a ``TensorDictSequential`` that is ``partial_tolerant`` leaves the planner
        out then, as it does every module that lacks an input.

    Raises:
        ValueError: for settings out of range, or modules of another latent size; by the call, for an observation that
            is not finite.
        TypeError: for unknown settings, an optimiser or modules that are none, or modules that ``engine="fused"`` would
            bypass.
        FloatingPointError: by the call, when the networks give no plan of a row a finite rating: it never acts at
            random. Single plans that overflow rank last.
        KeyError: by the call, when the encoder's input is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator, SafeSet
        >>> from ls3_torchrl.modules import ValueEnsemble
        >>> from ls3_torchrl.planners import CrossEntropyMethod
        >>> spec = Bounded(low=-1.0, high=1.0, shape=(2,))
        >>> model = LatentEnv(EnsembleDynamics(8, 2), ConstraintEstimator(8), GoalEstimator(8), action_spec=spec)
        >>> cem = CrossEntropyMethod(num_candidates=50, num_elites=5)
        >>> planner = LS3Planner(model, ValueEnsemble(8), SafeSet(8), optimizer=cem)
        >>> planner(TensorDict({"latent": torch.zeros(3, 8)}, [3]))["action"].shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        model: LatentEnv,
        value: TensorDictModuleBase,
        safe_set: TensorDictModuleBase,
        encoder: TensorDictModuleBase | None = None,
        optimizer: Optimizer | None = None,
        *,
        horizon: int = 5,
        num_particles: int = 20,
        safe_set_threshold: float | None = 0.8,
        constraint_threshold: float | None = 0.2,
        relaxation: float = 0.8,
        max_relaxations: int = 5,
        safe_set_reduction: SafeSetReduction = "mean",
        noise_scale: float = 1.0,
        max_ms: float | None = None,
        engine: EngineName = "auto",
        precision: Precision = "auto",
        action_key: NestedKey = "action",
        latent_key: NestedKey = "latent",
        plan_key: NestedKey = "plan",
        is_init_key: NestedKey = "is_init",
        **optimizer_settings: Any,
    ) -> None:
        super().__init__(model, action_key=action_key)
        self.action_spec = model.full_action_spec[model.action_key]  # also where the model has it under another name
        self.optimizer = optimizer_or_default(optimizer, optimizer_settings, owner=type(self))
        ControlOptions(
            horizon=horizon,
            num_particles=num_particles,
            safe_set_threshold=safe_set_threshold,
            constraint_threshold=constraint_threshold,
            relaxation=relaxation,
            max_relaxations=max_relaxations,
            safe_set_reduction=safe_set_reduction,
            noise_scale=noise_scale,
            max_ms=max_ms,
            engine=engine,
            precision=precision,
        )
        self.horizon, self.num_particles = horizon, num_particles
        self.safe_set_threshold, self.constraint_threshold = safe_set_threshold, constraint_threshold
        self.relaxation, self.max_relaxations = float(relaxation), max_relaxations
        self.noise_scale, self.max_ms = noise_scale, max_ms
        self.value, self.safe_set, self.encoder = value, safe_set, encoder
        self._require_modules()
        self.engine = Engine(
            model,
            value,
            safe_set,
            engine,
            precision=precision,
            safe_set_reduction=safe_set_reduction,
        )

        self.action_key = unravel_key(action_key)
        self.latent_key = _latent_key(encoder, latent_key)
        space = self.action_spec.space
        self.decisions = Decisions(plan_key)
        self.warm_start = WarmStart(space.low, space.high, horizon, plan_key, is_init_key)
        self._warned = False
        self._observation_keys = [self.latent_key] if encoder is None else list(encoder.in_keys)
        warm_keys = self.warm_start.in_keys if self.optimizer.uses_warm_start else []
        self.in_keys = [*self._observation_keys, *warm_keys]
        self.out_keys = [self.action_key, *self.decisions.keys.values(), *self.warm_start.out_keys]

    def _require_modules(self) -> None:
        """Find what does not fit by calling every head once, rather than in the first plan."""
        for name, module in (("value", self.value), ("safe_set", self.safe_set), ("encoder", self.encoder)):
            if name != "encoder" or module is not None:
                require_module(module, name)
        heads = {
            "value": self.value,
            "safe_set": self.safe_set,
            "constraint": self.env.constraint,
            "goal": self.env.goal,
        }
        latent = torch.zeros(1, self.env.latent_dim, device=self.env.device, dtype=self.env.latent_dtype)
        for name, head in heads.items():
            with torch.no_grad(), torch.random.fork_rng(enabled=True, devices=[]):
                _call_once(name, head, latent)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that carries the warm start from step to step and resets it with the episode.

        TorchRL finds it by itself: ``get_primers_from_module(planner)``, ``get_env_transforms_from_module(planner)``,
        ``Collector(env, planner, auto_register_policy_transforms=True)``.
        """
        return self.warm_start.make_tensordict_primer()

    def register_collector(self, collector: object) -> None:
        """Nothing: a plan depends on no collector, and a reference to one would keep the planner from being pickled."""

    @property
    def imagine(self) -> Imagination:
        """What imagines plans now; modules may have been exchanged, or hooked, since the last plan."""
        return self.engine.choose((self.env, self.value, self.safe_set))

    def sample_noise(self, batch: int) -> PlanNoise:
        """All noise that a plan for ``batch`` rows can need; large, meant for tests and comparisons."""
        rows = torch.arange(batch, device=self.action_spec.device)
        candidates, imagined = [], []
        for _ in range(self.optimizer.max_iterations(self.max_relaxations)):
            candidates.append(self.optimizer.sample_noise(rows, self.horizon, self.action_spec.shape[-1]))
            imagined.append(self._sample_imagination_noise(batch))
        members, dynamics = (torch.stack(parts) for parts in zip(*imagined, strict=True))
        return PlanNoise(tuple(torch.stack(parts) for parts in zip(*candidates, strict=True)), members, dynamics)

    def _sample_imagination_noise(self, rows: int) -> ImaginationNoise:
        sizes = (rows, self.horizon, self.num_particles)
        sampled = sample_imagination_noise(self.env, *sizes, device=self.action_spec.device)
        return sampled._replace(noise=self.noise_scale * sampled.noise)

    def encode(self, tensordict: TensorDictBase) -> Tensor:
        """The latent ``[*B, D]`` to plan from, float32."""
        require_keys(tensordict, self._observation_keys, "LS3Planner")
        if not tensordict.batch_size.numel():  # not every encoder can do with no rows at all
            return torch.zeros(*tensordict.batch_size, self.env.latent_dim, device=self.action_spec.device)
        if self.encoder is None:
            latent = tensordict.get(self.latent_key)
            self._require_latent(latent, tensordict)
        else:
            for key in self._observation_keys:
                require_finite(tensordict.get(key), f"The observation {key!r}")
            with set_interaction_type(InteractionType.DETERMINISTIC):
                latent = self.encoder(tensordict.select(*self._observation_keys)).get(self.latent_key)
            self._require_latent(latent, tensordict)
        require_finite(latent, "The latent to plan from")
        return latent.float()

    def _require_latent(self, latent: Tensor, tensordict: TensorDictBase) -> None:
        if latent.shape[-1] != self.env.latent_dim or latent.shape[: tensordict.ndim] != tensordict.batch_size:
            raise ValueError(
                f"The latent {self.latent_key!r} to plan from has shape {list(latent.shape)}, but the dynamics need "
                f"[*B, {self.env.latent_dim}] with the batch {list(tensordict.batch_size)} in front. Use the encoder "
                "that the dynamics were trained on."
            )

    def score_plans(self, statistics: PlanStatistics, threshold: Tensor) -> PlanScores:
        """Objective, feasibility and fallback ranking of candidates under δ_S ``[b, 1]``; 0 allows every end."""
        limit, inside = self.constraint_limit, self.safe_set_threshold is not None
        return PlanScores(
            objective(statistics),
            feasible(statistics, safe_set_threshold=threshold, constraint_threshold=limit),
            least_harm(statistics, constraint_threshold=limit, safe_set=inside),
            restart=~ends_inside(statistics, safe_set_threshold=threshold).any(-1),
        )

    @property
    def constraint_limit(self) -> float:
        """δ_C as a number, 1 for none, which no probability exceeds."""
        return 1.0 if self.constraint_threshold is None else float(self.constraint_threshold)

    @torch.compiler.disable  # a search with data-dependent ends, over threads of its own: nothing to trace
    @torch.no_grad()
    def plan(
        self,
        latent: Tensor,
        mean: Tensor | None = None,
        std: Tensor | None = None,
        noise: PlanNoise | None = None,
        *,
        deadline: Deadline | None = None,
    ) -> OptimizerResult:
        """Plan from latents, the tensors' way.

        Args:
            latent: ``[B, D]``.
            mean: mean of the first round's Gaussian, ``[B, H, A]``.
            std: its standard deviation.
            noise: all randomness; drawn when ``None``.
            deadline: when to end; ``max_ms`` from now on when ``None``.
        """
        relaxations = 0 if self.safe_set_threshold is None else self.max_relaxations

        def rate(statistics: PlanStatistics, threshold: Tensor, _actions: Tensor, _rows: Tensor) -> PlanScores:
            return self.score_plans(statistics, threshold)

        return self.search(latent, rate, relaxations, mean, std, noise, deadline=deadline)

    @torch.no_grad()
    def search(
        self,
        latent: Tensor,
        rate: RatePlans,
        relaxations: int,
        mean: Tensor | None = None,
        std: Tensor | None = None,
        noise: PlanNoise | None = None,
        *,
        first: Tensor | None = None,
        deadline: Deadline | None = None,
        reserve: int = 0,
    ) -> OptimizerResult:
        """Search for plans that are rated otherwise than by their value.

        Args:
            latent: ``[B, D]``.
            rate: what takes the place of :meth:`score_plans`: (statistics, δ_S ``[b, 1]``, actions ``[b, N, H, A]``,
                rows ``[b]``) -> scores.
            relaxations: how often δ_S may be relaxed.
            mean: as in :meth:`plan`.
            std: as in :meth:`plan`.
            noise: as in :meth:`plan`.
            first: the action ``[B, A]`` with which every plan begins, whatever is searched for the steps after it.
            deadline: as in :meth:`plan`.
            reserve: rounds of a later search that must end before the deadline, too.
        """
        deadline = Deadline(self.max_ms) if deadline is None else deadline
        deadline.begin_round()
        latent, imagine, space = latent.float(), self.imagine, self.action_spec.space

        def score(actions: Tensor, rows: Tensor, restarts: Tensor, iteration: int) -> PlanScores:
            if noise is None:
                sampled = self._sample_imagination_noise(len(rows))
            else:
                sampled = noise.of_iteration(iteration, rows)
            threshold = self._threshold(restarts).unsqueeze(-1)
            limits = Limits(threshold, self.constraint_limit)
            if first is not None:
                actions = torch.cat([first[rows, None, None].expand_as(actions[:, :, :1]), actions[:, :, 1:]], 2)
            statistics = imagine(latent[rows], actions, sampled, limits)
            scores = rate(statistics, threshold, actions, rows)
            require_sound(statistics, scores)
            if deadline.leaves_time(1 + reserve):
                return scores
            return scores._replace(enough=torch.ones_like(rows, dtype=torch.bool))

        def given(rows: Tensor, iteration: int) -> tuple[Tensor, ...]:
            assert noise is not None
            return tuple(part[iteration][rows] for part in noise.candidates)

        with imagine.parameters_fixed():
            return self.optimizer(
                score,
                space.low.float(),
                space.high.float(),
                batch=latent.shape[0],
                horizon=self.horizon,
                max_restarts=relaxations,
                mean=mean,
                std=std,
                noise=None if noise is None else given,
            )

    def _threshold(self, restarts: Tensor) -> Tensor:
        return (self.safe_set_threshold or 0.0) * self.relaxation ** restarts.to(torch.float32)

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
        # No compiled graph looks at a clock: there, time counts from the search on.
        deadline = None if torch.compiler.is_compiling() else Deadline(self.max_ms)
        out = tensordict if tensordict_out is None else tensordict_out
        latent = self.encode(tensordict)
        batch = latent.shape[:-1]
        rows = batch.numel()
        mean, std = self.read_warm_start(tensordict, rows)
        result = self.plan(latent.reshape(rows, latent.shape[-1]), mean, std, noise, deadline=deadline)
        require_finite(result.actions, f"The plan of {type(self.optimizer).__name__}")
        space = self.action_spec.space
        # Once more, in the spec's own dtype: a bound of it may lie between two numbers of float32.
        action = result.actions[:, 0].to(self.action_spec.dtype).clamp(space.low, space.high)
        out.set(self.action_key, action.reshape(*batch, action.shape[-1]))
        self.decisions.write(out, result, self._threshold(result.restarts), batch)
        self.warm_start.write(out, result.mean, result.std)
        return out

    def read_warm_start(self, tensordict: TensorDictBase, rows: int) -> tuple[Tensor | None, Tensor | None]:
        """The last plan's Gaussian ``[rows, H, A]``, where the optimiser uses it and the tensordict has it."""
        if not self.optimizer.uses_warm_start:
            return None, None
        mean, std = self.warm_start.read(tensordict, rows)
        if mean is None and not self._warned:
            self._warned = True
            warnings.warn(
                f"LS3Planner found no last plan under {list(self.warm_start.keys.values())} to start from, although "
                "its optimiser draws candidates round it (p_random below 1). It starts from the whole box, at every "
                "step unless the environment carries the plan on: append InitTracker() and "
                "planner.make_tensordict_primer() to the environment, or collect with "
                "Collector(..., auto_register_policy_transforms=True).",
                stacklevel=2,
            )
        return mean, std

    def imagine_plans(self, latent: Tensor, actions: Tensor) -> PlanStatistics:
        """What the planner imagines of given plans ``[B, N, H, A]`` from latents ``[B, D]``, for pictures."""
        return self.imagine(latent.float(), actions.float(), self._sample_imagination_noise(len(latent)))


def _latent_key(encoder: TensorDictModuleBase | None, latent_key: NestedKey) -> NestedKey:
    """Where the latent lies: under ``latent_key``, or under what an encoder writes instead."""
    key = unravel_key(latent_key)
    if encoder is None or key in {unravel_key(out) for out in encoder.out_keys}:
        return key
    return posterior_keys(encoder)[0]


def _call_once(name: str, head: TensorDictModuleBase, latent: Tensor) -> None:
    """Refuse a head that cannot read such latents, or writes anything but one number or one for each member."""
    try:
        out = call_on_latent(head, latent)
    except (RuntimeError, KeyError, IndexError) as error:
        raise ValueError(
            f"{name} ({type(head).__name__}) cannot read latents of size {latent.shape[-1]}, which the dynamics have: "
            f"{' '.join(str(error).split())[:150]}. Make all networks for one latent_dim."
        ) from error
    shapes = [1, 1], [1, out.shape[1] if out.ndim > 1 else 0, 1]
    if list(out.shape) not in (shapes if name == "value" else shapes[:1]):
        allowed = "[*B, 1], or [*B, M, 1] of M members" if name == "value" else "[*B, 1]"
        raise ValueError(
            f"{name} ({type(head).__name__}) must write {allowed} as its first output; for a latent [1, "
            f"{latent.shape[-1]}] it wrote {list(out.shape)}."
        )
