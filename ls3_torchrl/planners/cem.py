"""The cross-entropy method on plain tensors; it knows no model (supplement, "Cross Entropy Method")."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ls3_torchrl._values import require_at_least
from ls3_torchrl.options.planner import CEMOptions
from ls3_torchrl.planners.optimizer import NoiseSource, Optimizer, OptimizerResult, PlanScores, ScorePlans


class _Elites(NamedTuple):
    """The best sequences of b rows: feasible ones, or where there are none those that rank best otherwise.

    Attributes:
        actions: best first, ``[b, E, H, A]``; where fewer are feasible, the rest is filled up with others.
        score: ``[b, E]``, −∞ for those that fill up; the fallback ranking where nothing is feasible.
        feasible: bool ``[b]``, whether anything is.
        restart: bool ``[b]``, whether the row is to start again.
    """

    actions: Tensor
    score: Tensor
    feasible: Tensor
    restart: Tensor


@dataclass
class _Search:
    """How far the search of B rows has come; the first dimension of every field is B."""

    start_mean: Tensor
    start_std: Tensor
    mean: Tensor
    std: Tensor
    best: Tensor
    best_score: Tensor
    #: Rounds done since the last start.
    step: Tensor
    restarts: Tensor
    iterations: Tensor
    #: Whether a feasible sequence was ever found.
    found: Tensor

    @classmethod
    def begin(cls, mean: Tensor, std: Tensor) -> _Search:
        """Nothing is known but the Gaussian, ``[B, H, A]`` each, that the first round samples."""
        score = torch.full(mean.shape[:1], -torch.inf, device=mean.device)
        count = torch.zeros_like(score, dtype=torch.long)
        best, found = torch.zeros(mean.shape, device=mean.device), torch.zeros_like(score, dtype=torch.bool)
        return cls(mean, std, mean.clone(), std.clone(), best, score, count, count.clone(), count.clone(), found)

    def result(self) -> OptimizerResult:
        """What was found."""
        return OptimizerResult(
            self.best, self.best_score, self.mean, self.std, self.restarts, ~self.found, self.iterations
        )


class CrossEntropyMethod:
    """Sample, score, keep the elites, refit; for a batch of independent rows side by side.

    In the first round ``p_random`` of the candidates are uniform in the box, ``p_constant`` of them hold one
    uniform action, and the rest come from the given Gaussian; later rounds sample the refitted one, clamped to
    the box. A row in which nothing is feasible goes on among the sequences with the best fallback ranking, or starts
    again from its first round, up to ``max_restarts`` times, where ``score_plans`` wants it to. The outcome is the best
    feasible sequence that was scored, or if there was none the one with the best fallback ranking: no iteration is
    sampled without being scored.

    An :class:`~ls3_torchrl.planners.Optimizer`; the defaults are Table 1's.

    Args:
        num_candidates: N.
        num_elites: sequences that the Gaussian is refitted on, 1 to N; ``None`` for a tenth of N, as in
            Table 1. Fewer where fewer are feasible.
        optim_steps: rounds, each scored. Table 1's n_cem_iters = 5 samples five iterations and scores four.
        p_random: fraction of uniform candidates in the first round, in [0, 1].
        p_constant: fraction of candidates in the first round that hold one uniform action over the whole horizon.
            Actions drawn independently step by step mostly cancel; a way that has to be kept up is found among
            correlated ones (as in Pinneri et al. 2020, arXiv 2008.06389). 0 is the paper.

    Raises:
        ValueError: for settings out of range.

    Example:
        >>> import torch
        >>> low, high = torch.tensor([-1.0]), torch.tensor([2.0])
        >>> def quadratic(actions, rows, restarts, iteration):
        ...     score = -(actions - 0.5).square().sum((-1, -2))
        ...     return PlanScores(score, torch.ones_like(score, dtype=torch.bool), score)
        >>> cem = CrossEntropyMethod(num_candidates=500, num_elites=20, optim_steps=8)
        >>> result = cem(quadratic, low, high, batch=1, horizon=3)
        >>> bool((result.actions - 0.5).abs().max() < 0.05)
        True
    """

    def __init__(
        self,
        *,
        num_candidates: int = 1000,
        num_elites: int | None = None,
        optim_steps: int = 4,
        p_random: float = 1.0,
        p_constant: float = 0.0,
    ) -> None:
        CEMOptions(
            num_candidates=num_candidates,
            num_elites=num_elites,
            optim_steps=optim_steps,
            p_random=p_random,
            p_constant=p_constant,
        )
        self.num_candidates = num_candidates
        self.num_elites = max(int(num_candidates) // 10, 1) if num_elites is None else num_elites
        self.optim_steps = optim_steps
        self.p_random = p_random
        self.p_constant = p_constant

    @property
    def num_random(self) -> int:
        """How many candidates of a first round are uniform."""
        return round(self.p_random * self.num_candidates)

    @property
    def num_constant(self) -> int:
        """How many candidates of a first round hold one action over the horizon."""
        return min(round(self.p_constant * self.num_candidates), self.num_candidates - self.num_random)

    @property
    def uses_warm_start(self) -> bool:
        """Whether some candidates of a first round are drawn from the given Gaussian."""
        return self.num_random + self.num_constant < self.num_candidates

    def max_iterations(self, max_restarts: int) -> int:
        """The most iterations that a row can score."""
        return self.optim_steps * (max_restarts + 1)

    def sample_noise(self, rows: Tensor, horizon: int, action_dim: int) -> tuple[Tensor, Tensor]:
        """Noise of one iteration, standard normal and uniform in [0, 1), each ``[b, N, H, A]``."""
        shape = (rows.numel(), self.num_candidates, horizon, action_dim)
        return torch.randn(shape, device=rows.device), torch.rand(shape, device=rows.device)

    def __call__(
        self,
        score_plans: ScorePlans,
        low: Tensor,
        high: Tensor,
        *,
        batch: int,
        horizon: int,
        max_restarts: int = 0,
        mean: Tensor | None = None,
        std: Tensor | None = None,
        noise: NoiseSource | None = None,
    ) -> OptimizerResult:
        """Optimise ``batch`` sequences of ``horizon`` actions in the box; see :class:`Optimizer` for the arguments."""
        require_at_least(max_restarts, 0, "max_restarts")
        low, high = low.float(), high.float()
        shape = (batch, horizon, low.shape[-1])
        search = _Search.begin(
            ((low + high) / 2).expand(shape) if mean is None else mean.float(),
            ((high - low) / 4).expand(shape) if std is None else std.float(),
        )
        rows, iteration = torch.arange(batch, device=low.device), 0
        while rows.numel():
            drawn = self.sample_noise(rows, *shape[1:]) if noise is None else noise(rows, iteration)
            actions = self._candidates(search, rows, drawn, low, high)
            scores = score_plans(actions, rows, search.restarts[rows], iteration)
            search.iterations[rows] += 1
            elites = self._select(actions, scores)
            self._keep_best(search, rows, elites)
            self._refit(search, rows, elites)
            ended = torch.zeros_like(elites.restart) if scores.enough is None else scores.enough
            self._restart(search, rows, elites.restart, ended | (search.restarts[rows] >= max_restarts))
            search.step[rows[ended]] = self.optim_steps
            rows = rows[search.step[rows] < self.optim_steps]
            iteration += 1
        return search.result()

    def _candidates(
        self, search: _Search, rows: Tensor, noise: tuple[Tensor, ...], low: Tensor, high: Tensor
    ) -> Tensor:
        """Sequences ``[b, N, H, A]`` to score next: round the Gaussian, and in a first round uniform and held ones."""
        normal, uniform = noise
        index = torch.arange(self.num_candidates, device=low.device)
        uniform_first = index < self.num_random + self.num_constant
        actions = search.mean[rows, None] + search.std[rows, None] * normal
        if self.num_constant:
            held = uniform_first & (index >= self.num_random)
            uniform = torch.where(held[:, None, None], uniform[..., :1, :], uniform)
        is_uniform = (search.step[rows] == 0)[:, None] & uniform_first
        actions = torch.where(is_uniform[..., None, None], low + (high - low) * uniform, actions)
        return actions.clamp(low, high)

    def _select(self, actions: Tensor, scores: PlanScores) -> _Elites:
        """The best candidates of each row, feasible ones alone where there are any."""
        score = scores.score.float()
        feasible = scores.feasible & (score > -torch.inf)  # False for NaN too
        found = feasible.any(-1)
        ranking = scores.fallback.float().nan_to_num(nan=-torch.inf)
        score = torch.where(found[:, None], score.masked_fill(~feasible, -torch.inf), ranking)
        score, elite = score.topk(self.num_elites, dim=-1)
        best = actions.gather(1, elite[..., None, None].expand(-1, -1, *actions.shape[2:]))
        return _Elites(best, score, found, ~found if scores.restart is None else ~found & scores.restart)

    def _keep_best(self, search: _Search, rows: Tensor, elites: _Elites) -> None:
        """The best sequence of all populations; a feasible one goes before all others."""
        found = search.found[rows]
        better = (elites.score[:, 0] > search.best_score[rows]) & (elites.feasible | ~found)
        better |= (elites.feasible & ~found) | (search.iterations[rows] == 1)
        search.best[rows[better]] = elites.actions[better, 0]
        search.best_score[rows[better]] = elites.score[better, 0]
        search.found[rows[elites.feasible]] = True

    def _refit(self, search: _Search, rows: Tensor, elites: _Elites) -> None:
        """Rows that do not start again: their Gaussian is refitted on the elites."""
        going_on = ~elites.restart
        search.step[rows[going_on]] += 1
        ranked = elites.score > -torch.inf
        weight = ranked.to(elites.actions)[..., None, None]
        weight = weight / weight.sum(1, keepdim=True).clamp(min=1.0)
        mean = (weight * elites.actions).sum(1)
        std = (weight * (elites.actions - mean[:, None]).square()).sum(1).sqrt()
        refitted = going_on & ranked.any(-1)
        search.mean[rows[refitted]] = mean[refitted]
        search.std[rows[refitted]] = std[refitted]

    def _restart(self, search: _Search, rows: Tensor, restart: Tensor, last: Tensor) -> None:
        """Of the rows, those of ``restart`` start again, or are done where this start was the last."""
        again, done = rows[restart & ~last], rows[restart & last]
        search.restarts[again] += 1
        search.step[again] = 0
        search.mean[again], search.std[again] = search.start_mean[again], search.start_std[again]
        search.step[done] = self.optim_steps
        lost = done[~search.found[done]]
        # As wide as they began: nothing told them where to search.
        search.mean[lost], search.std[lost] = search.best[lost], search.start_std[lost]


def optimizer_or_default(optimizer: Optimizer | None, settings: dict[str, Any], *, owner: type) -> Optimizer:
    """The given optimiser, or the cross-entropy method with ``settings``; what fits neither is refused by name.

    Args:
        optimizer: the user's, if any.
        settings: what the user passed to ``owner`` beside its own settings.
        owner: class whose settings the message lists.
    """
    known = list(inspect.signature(CrossEntropyMethod).parameters)
    unknown = [name for name in settings if name not in known]
    if unknown:
        own = [name for name, p in inspect.signature(owner).parameters.items() if p.kind is not p.VAR_KEYWORD]
        raise TypeError(
            f"{owner.__name__} knows no setting {', '.join(unknown)}. Its own are {', '.join(own)}; those of its "
            f"optimiser, CrossEntropyMethod, are {', '.join(known)}."
        )
    if optimizer is None:
        return CrossEntropyMethod(**settings)
    if settings:
        raise TypeError(
            f"{', '.join(settings)} are settings of the optimiser: give them to {type(optimizer).__name__}, which was "
            "passed as optimizer."
        )
    if not isinstance(optimizer, Optimizer):
        needed = ("num_candidates", "uses_warm_start", "max_iterations", "sample_noise", "__call__")
        missing = [name for name in needed if not hasattr(optimizer, name)]
        raise TypeError(f"optimizer must be an Optimizer; {type(optimizer).__name__} lacks {', '.join(missing)}.")
    return optimizer
