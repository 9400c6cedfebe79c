"""The cross-entropy method on plain tensors; it knows no model (supplement, "Cross Entropy Method")."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ls3_torchrl._checks import require_at_least


class PlanScores(NamedTuple):
    """What the caller says of a iteration of b × N sequences, each field ``[b, N]``.

    Attributes:
        score: the objective; NaN ranks last.
        feasible: bool, whether the sequence may be carried out.
        fallback: ranking for rows in which nothing is feasible.
    """

    score: Tensor
    feasible: Tensor
    fallback: Tensor


class ScorePlans(Protocol):
    """Judges candidate sequences."""

    def __call__(self, actions: Tensor, rows: Tensor, restarts: Tensor, iteration: int) -> PlanScores:
        """Judge ``actions`` ``[b, N, H, A]`` of batch rows ``rows`` ``[b]``, restarted ``restarts`` ``[b]`` times."""


#: Draws the noise of one iteration: (rows ``[b]``, iteration) -> standard normal and uniform in [0, 1), each
#: ``[b, N, H, A]``; the uniform one covers the first ``num_random + num_constant`` candidates at least.
CandidateNoise = Callable[[Tensor, int], tuple[Tensor, Tensor]]


class CEMResult(NamedTuple):
    """The outcome for B rows.

    Attributes:
        actions: the best sequence that was scored, ``[B, H, A]``.
        score: its score, ``[B]``; for a fallback its fallback ranking.
        mean: mean of the last elites, ``[B, H, A]``.
        std: their standard deviation, ``[B, H, A]``.
        restarts: how often each row started again, int64 ``[B]``.
        fallback: bool ``[B]``, nothing feasible was ever found.
        iterations: how many iterations each row had scored, int64 ``[B]``.
    """

    actions: Tensor
    score: Tensor
    mean: Tensor
    std: Tensor
    restarts: Tensor
    fallback: Tensor
    iterations: Tensor


class CrossEntropyMethod:
    """Sample, score, keep the elites, refit; for a batch of independent problems side by side.

    In the first round ``p_random`` of the candidates are uniform in the box, ``p_constant`` of them hold one
    uniform action, and the rest come from the given Gaussian; later rounds sample the refitted one, clamped to
    the box. A row in which nothing is feasible starts again from its first round, up to ``max_restarts`` times;
    after that it takes the sequence with the best fallback ranking (unless an earlier round had found a feasible
    one). The outcome is the best sequence that was scored: no iteration is drawn without being scored.

    Args:
        num_candidates: N.
        num_elites: sequences that the Gaussian is refitted on, 1 to N; fewer where fewer are feasible.
        optim_steps: rounds, each scored.
        max_restarts: how often a row may start again.
        p_random: share of uniform candidates in the first round, in [0, 1].
        p_constant: share of candidates in the first round that hold one uniform action over the whole horizon.
            Actions drawn independently step by step mostly cancel; a way that has to be kept up is found among
            correlated ones (as in Pinneri et al. 2020, arXiv 2008.06389). 0 is the paper.
        min_std: floor of the refitted standard deviation as a share of the box's side; 0 is the paper.

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
        num_candidates: int,
        num_elites: int,
        optim_steps: int,
        max_restarts: int = 5,
        p_random: float = 1.0,
        p_constant: float = 0.0,
        min_std: float = 0.0,
    ) -> None:
        self.num_candidates = require_at_least(num_candidates, 1, "num_candidates")
        if not 1 <= num_elites <= num_candidates:
            raise ValueError(f"num_elites must lie between 1 and num_candidates = {num_candidates}, got {num_elites}.")
        if not 0.0 <= p_random <= 1.0:
            raise ValueError(f"p_random must lie in [0, 1], got {p_random}.")
        if not 0.0 <= p_constant <= 1.0 or p_random + p_constant > 1.0:
            raise ValueError(
                f"p_constant must lie in [0, 1] and leave room for p_random, got p_constant={p_constant} and "
                f"p_random={p_random}: together they must not exceed 1."
            )
        if min_std < 0.0:
            raise ValueError(f"min_std must not be negative, got {min_std}.")
        self.num_elites = num_elites
        self.optim_steps = require_at_least(optim_steps, 1, "optim_steps")
        self.max_restarts = require_at_least(max_restarts, 0, "max_restarts")
        self.p_random = p_random
        self.p_constant = p_constant
        self.min_std = min_std

    @property
    def num_random(self) -> int:
        """How many candidates of a first round are uniform."""
        return round(self.p_random * self.num_candidates)

    @property
    def num_constant(self) -> int:
        """How many candidates of a first round hold one action over the horizon."""
        return min(round(self.p_constant * self.num_candidates), self.num_candidates - self.num_random)

    @property
    def max_iterations(self) -> int:
        """The most iterations that a row can score."""
        return self.optim_steps * (self.max_restarts + 1)

    def draw(self, rows: Tensor, horizon: int, action_dim: int) -> tuple[Tensor, Tensor]:
        """Fresh candidate noise from torch's global generator, standard normal and uniform."""
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
        mean: Tensor | None = None,
        std: Tensor | None = None,
        noise: CandidateNoise | None = None,
    ) -> CEMResult:
        """Optimise ``batch`` sequences of ``horizon`` actions in the box.

        Args:
            score_plans: judges candidates.
            low: lower bounds ``[A]``.
            high: upper bounds ``[A]``.
            batch: B.
            horizon: H.
            mean: mean of the first rounds' Gaussian, ``[B, H, A]``; the box's middle when ``None``.
            std: its standard deviation; a quarter of the box's side when ``None``.
            noise: source of candidate noise; fresh draws when ``None``.
        """
        device, shape = low.device, (batch, horizon, low.shape[-1])
        side = high - low
        start_mean = ((low + high) / 2).expand(shape) if mean is None else mean
        start_std = (side / 4).expand(shape) if std is None else std
        mean, std = start_mean.clone(), start_std.clone()
        best = torch.zeros(shape, device=device)
        best_score = torch.full((batch,), -torch.inf, device=device)
        step = torch.zeros(batch, dtype=torch.long, device=device)
        restarts, iterations = torch.zeros_like(step), torch.zeros_like(step)
        found = torch.zeros(batch, dtype=torch.bool, device=device)
        index = torch.arange(self.num_candidates, device=device)
        uniform_first = index < self.num_random + self.num_constant
        constant = (uniform_first & (index >= self.num_random))[:, None, None]

        rows = torch.arange(batch, device=device)
        iteration = 0
        while rows.numel():
            normal, uniform = self.draw(rows, horizon, shape[-1]) if noise is None else noise(rows, iteration)
            actions = mean[rows, None] + std[rows, None] * normal
            if self.num_constant:
                uniform = torch.where(constant, uniform[..., :1, :], uniform)
            is_uniform = (step[rows] == 0)[:, None] & uniform_first
            actions = torch.where(is_uniform[..., None, None], low + side * uniform, actions)
            actions = actions.clamp(low, high)

            score, allowed, fallback = score_plans(actions, rows, restarts[rows], iteration)
            iterations[rows] += 1
            allowed = allowed & (score > -torch.inf)  # False for NaN too
            score = score.masked_fill(~allowed, -torch.inf)
            elite_score, elite = score.topk(self.num_elites, dim=-1)
            any_allowed = allowed.any(-1)

            top = actions.gather(1, elite[..., None, None].expand(-1, -1, *actions.shape[2:]))
            weight = (elite_score > -torch.inf).to(actions)[..., None, None]
            weight = weight / weight.sum(1, keepdim=True).clamp(min=1.0)
            elite_mean = (weight * top).sum(1)
            elite_std = (weight * (top - elite_mean[:, None]).square()).sum(1).sqrt()

            good = rows[any_allowed]
            mean[good] = elite_mean[any_allowed]
            std[good] = torch.maximum(elite_std[any_allowed], self.min_std * side)
            better = any_allowed & (elite_score[:, 0] > best_score[rows])
            best[rows[better]] = top[better, 0]
            best_score[rows[better]] = elite_score[better, 0]
            found[good] = True
            step[good] += 1

            none = rows[~any_allowed]
            exhausted = restarts[none] >= self.max_restarts
            again, lost = none[~exhausted], none[exhausted & ~found[none]]
            restarts[again] += 1
            step[again] = 0
            mean[again], std[again] = start_mean[again], start_std[again]
            step[none[exhausted]] = self.optim_steps  # these rows are done
            if lost.numel():
                position = torch.isin(rows, lost).nonzero().flatten()
                harm = fallback[position].nan_to_num(nan=-torch.inf)
                choice = harm.argmax(-1)
                best[lost] = actions[position, choice]
                best_score[lost] = harm.gather(-1, choice[:, None]).squeeze(-1)
                mean[lost], std[lost] = best[lost], start_std[lost]
            rows = rows[step[rows] < self.optim_steps]
            iteration += 1
        return CEMResult(best, best_score, mean, std, restarts, ~found, iterations)
