"""A safety filter for any policy: its action is carried out where a feasible plan starts with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TensorDictPrimer

from ls3_torchrl._checks import require_finite, require_keys
from ls3_torchrl.planners.deadline import Deadline
from ls3_torchrl.planners.ls3 import LS3Planner
from ls3_torchrl.planners.optimizer import PlanScores
from ls3_torchrl.planners.scoring import PlanStatistics

_NAMES = ("proposed", "intervened", "feasible", "constraint", "safe_set", "distance")


Policy = Callable[[TensorDictBase], TensorDictBase]


class _Verdict(NamedTuple):
    """Of B rows: what is carried out, the Gaussian for the next step, and why the proposal was not, if it was not."""

    action: Tensor
    mean: Tensor
    std: Tensor
    certified: Tensor
    feasible: Tensor
    avoidable: Tensor


class SafeSetFilter(TensorDictModuleBase):
    """Lets the action of any policy through where it is safe, and otherwise takes the safest one.

    An action is safe where an imagined plan that starts with it is feasible: f_C ≤ δ_C at every step and
    f_S(z_H) ≥ δ_S at the end, so that the way back into the safe set is always known. Where none is found, the filter
    carries out the first action of the safest feasible plan,

        max f_S(z_H) − max_i f_C(z_i)  subject to  f_C(z_i) ≤ δ_C for i = 1…H and f_S(z_H) ≥ δ_S,

    and where no plan is feasible that of the plan with the fewest predicted violations, then the safest end. δ_S is
    never relaxed. What the policy is paid for does not matter: no value is asked. The feasible action nearest to the
    proposed one would change less, and is more dangerous: a policy that goes for an obstacle at every step is led along
    its very edge, and what no image shows, a fraction of a pixel, is then enough to touch it.

    It plans for all rows of a batch at once. Like the planner it carries its last plan from step to step, and is used
    like it: ``Collector(env, SafeSetFilter(policy, planner), auto_register_policy_transforms=True)``.

    Args:
        policy: any module that writes the planner's ``action_key``, or any function from a tensordict to one, such as
            TorchRL's ``RandomPolicy``; ``None`` where the tensordict holds the action already, a person's for example.
        planner: whose model, thresholds and optimiser are used, and ``max_ms`` for the policy and all plans together.
            With ``safe_set_threshold=None`` plans may end anywhere, as in a filter of H steps without a terminal set.
        filter_key: group under which is written what was decided.

    Returns:
        A call returns what ``policy`` writes, with the ``action`` that is carried out, and under ``filter``
        ``proposed`` ``[*B, A]``, the policy's action within its bounds; each ``[*B, 1]``, ``intervened``, whether
        another is carried out, and why: ``constraint``, every plan found that starts with it violates, or
        ``safe_set``, those that do not all end outside the safe set; ``feasible``, whether a feasible plan starts with
        what is carried out; ``distance`` between both actions. Under ``("next", "plan")`` the planner's warm start.

    Raises:
        TypeError: for a planner that is none.
        ValueError: for a policy that does not write the action, or writes what the filter writes; by the call, for an
            action or an observation that is not finite, or an action of another size.
        FloatingPointError: by the call, when the networks give no plan of a row a finite rating.
        KeyError: by the call, when an input is missing.

    Source: as a filter that looks at plans, Wabersich and Zeilinger, "A predictive safety filter for learning-based
    control", Automatica 2021, arXiv 1812.05506, with the learned safe set of LS³ as the terminal set.

    Example:
        >>> from torchrl.data import Bounded
        >>> from ls3_torchrl import LS3Agent
        >>> spec = Bounded(low=-1.0, high=1.0, shape=(2,))
        >>> planner = LS3Agent(action_spec=spec, latent_dim=8).planner(num_candidates=50, num_elites=5)
        >>> safe = SafeSetFilter(None, planner)
        >>> td = TensorDict({"pixels": torch.zeros(3, 3, 64, 64, dtype=torch.uint8), "action": torch.ones(3, 2)}, [3])
        >>> safe(td)["filter", "intervened"].shape
        torch.Size([3, 1])
    """

    def __init__(self, policy: Policy | None, planner: LS3Planner, *, filter_key: NestedKey = "filter") -> None:
        super().__init__()
        if not isinstance(planner, LS3Planner):
            raise TypeError(f"planner must be an LS3Planner, such as agent.planner(), got a {type(planner).__name__}.")
        self.action_key = planner.action_key
        written = [unravel_key(key) for key in getattr(policy, "out_keys", [])]
        if isinstance(policy, TensorDictModuleBase) and self.action_key not in written:
            raise ValueError(
                f"The policy must write {self.action_key!r}, the planner's action, but {type(policy).__name__} writes "
                f"{written}. Give both the same action key."
            )
        self.policy, self.planner = policy, planner
        self.keys = {name: unravel_key((filter_key, name)) for name in _NAMES}
        reads = [self.action_key] if policy is None else getattr(policy, "in_keys", [])
        self.in_keys = [key for key in dict.fromkeys([*reads, *planner.in_keys]) if key not in written]
        warm = planner.warm_start.out_keys
        if taken := sorted(str(key) for key in {*self.keys.values(), *warm} & set(written)):
            raise ValueError(
                f"Policy and filter would both write {', '.join(taken)}. Give the filter's planner a plan_key, or the "
                "filter a filter_key, of its own."
            )
        self.out_keys = list(dict.fromkeys([*written, self.action_key, *self.keys.values(), *warm]))

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that carries the last plan from step to step and resets it with the episode."""
        return self.planner.make_tensordict_primer()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action that is carried out, and what was decided."""
        planner = self.planner
        deadline = Deadline(planner.max_ms)
        out = tensordict if self.policy is None else self.policy(tensordict)
        require_keys(out, [self.action_key], "SafeSetFilter")
        latent, wanted = planner.encode(out), out.get(self.action_key)
        batch, spec = latent.shape[:-1], planner.action_spec
        if wanted.shape != (*batch, *spec.shape[-1:]):
            raise ValueError(
                f"The action {self.action_key!r} must have the shape {[*batch, *spec.shape[-1:]]}, got "
                f"{list(wanted.shape)}."
            )
        require_finite(wanted, "The policy's action")
        proposed = wanted.to(spec.dtype).clamp(spec.space.low, spec.space.high)
        rows = batch.numel()
        warm = planner.read_warm_start(out, rows)
        verdict = self._judge(latent.reshape(rows, -1), proposed.reshape(rows, -1).float(), *warm, deadline)
        chosen = verdict.action.to(spec.dtype).clamp(spec.space.low, spec.space.high).reshape(proposed.shape)
        action = torch.where(verdict.certified.reshape(*batch, 1), proposed, chosen)
        self._write(out, verdict, proposed, action)
        planner.warm_start.write(out, verdict.mean, verdict.std)
        return out.set(self.action_key, action)

    def _judge(
        self, latent: Tensor, proposed: Tensor, mean: Tensor | None, std: Tensor | None, deadline: Deadline
    ) -> _Verdict:
        """Of latents ``[B, D]`` and proposed actions ``[B, A]``."""
        planner, limit = self.planner, self.planner.constraint_limit
        avoidable = torch.zeros(len(latent), dtype=torch.bool, device=latent.device)

        def certify(statistics: PlanStatistics, threshold: Tensor, _actions: Tensor, rows: Tensor) -> PlanScores:
            scores = planner.score_plans(statistics, threshold)
            avoidable[rows] |= (statistics.constraint_prob <= limit).all(-1).any(-1)
            enough = scores.feasible.any(-1)
            return scores._replace(score=statistics.safe_set_prob, restart=torch.zeros_like(enough), enough=enough)

        kept = planner.search(latent, certify, 0, mean, std, first=proposed, deadline=deadline, reserve=1)
        certified = ~kept.fallback
        left = kept.fallback.nonzero().flatten()
        if not len(left):
            return _Verdict(proposed, kept.mean, kept.std, certified, certified, avoidable)

        def safest(statistics: PlanStatistics, threshold: Tensor, _actions: Tensor, _rows: Tensor) -> PlanScores:
            scores = planner.score_plans(statistics, threshold)
            anywhere = planner.safe_set_threshold is None
            margin = (0.0 if anywhere else statistics.safe_set_prob) - statistics.constraint_prob.amax(-1)
            return scores._replace(score=margin, restart=torch.zeros_like(scores.feasible[:, 0]))

        start = self._around(proposed[left], mean, std, left)
        found = planner.search(latent[left], safest, 0, *start, deadline=deadline)
        action = proposed.index_copy(0, left, found.actions[:, 0])
        feasible = certified.index_copy(0, left, ~found.fallback)
        new_mean, new_std = kept.mean.index_copy(0, left, found.mean), kept.std.index_copy(0, left, found.std)
        return _Verdict(action, new_mean, new_std, certified, feasible, avoidable)

    def _around(self, proposed: Tensor, mean: Tensor | None, std: Tensor | None, rows: Tensor) -> tuple[Tensor, Tensor]:
        """The last plan's Gaussian of the ``rows``, if there is one, but with a first action round the proposed one."""
        start = self.planner.warm_start
        shape = (len(proposed), self.planner.horizon, proposed.shape[-1])
        mean = start.middle.expand(shape) if mean is None else mean[rows]
        std = start.wide.expand(shape) if std is None else std[rows]
        return torch.cat([proposed[:, None], mean[:, 1:]], 1), torch.cat(
            [start.wide.expand_as(std[:, :1]), std[:, 1:]], 1
        )

    def _distance(self, one: Tensor, other: Tensor) -> Tensor:
        """Between actions ``[..., A]``, in units of half the range of each."""
        space = self.planner.action_spec.space
        return ((one - other) / ((space.high - space.low) / 2).float()).norm(dim=-1)

    def _write(self, out: TensorDictBase, verdict: _Verdict, proposed: Tensor, action: Tensor) -> None:
        certified, avoidable = verdict.certified, verdict.avoidable
        values = {
            "intervened": ~certified,
            "feasible": verdict.feasible,
            "constraint": ~certified & ~avoidable,
            "safe_set": ~certified & avoidable,
            "distance": self._distance(action.float(), proposed.float()),
        }
        out.set(self.keys["proposed"], proposed)
        for name, value in values.items():
            out.set(self.keys[name], value.reshape(*proposed.shape[:-1], 1))


def describe_filter(tensordict: TensorDictBase, filter_key: NestedKey = "filter") -> TensorDict:
    """Fractions of steps over a collected batch: how often the filter intervened, and why.

    Args:
        tensordict: what a rollout with the filter returned.
        filter_key: the filter's group.

    Returns:
        Scalars ``intervention_rate``, ``constraint_rate`` and ``safe_set_rate`` (why), ``infeasible_rate`` (what was
        carried out is not known to be safe) and ``distance``, the mean over all steps.

    Example:
        >>> flags = {"intervened": [[False], [True]], "feasible": [[True], [True]], "constraint": [[False], [True]]}
        >>> rest = {"safe_set": [[False], [False]], "distance": [[0.0], [0.5]]}
        >>> described = describe_filter(TensorDict({"filter": flags | rest}, [2]))
        >>> {name: value.item() for name, value in described.items() if value}
        {'intervention_rate': 0.5, 'constraint_rate': 0.5, 'distance': 0.25}
    """
    group = tensordict.get(filter_key)
    return TensorDict(
        {
            "intervention_rate": group["intervened"].float().mean(),
            "constraint_rate": group["constraint"].float().mean(),
            "safe_set_rate": group["safe_set"].float().mean(),
            "infeasible_rate": 1.0 - group["feasible"].float().mean(),
            "distance": group["distance"].mean(),
        }
    )
