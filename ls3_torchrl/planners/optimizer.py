"""What the planner asks of the optimiser that searches for plans; the cross-entropy method is one of many."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

from torch import Tensor


class PlanScores(NamedTuple):
    """How b × N action sequences are rated.

    Attributes:
        score: the objective ``[b, N]``, higher is better; NaN ranks last, and may stand for any sequence that is not
            feasible.
        feasible: bool ``[b, N]``, whether the sequence may be carried out.
        fallback: ranking ``[b, N]``, higher is better, for rows in which nothing is feasible.
        restart: bool ``[b]``, rows that are to start again under easier conditions where nothing is feasible; all of
            them when ``None``. The others go on among sequences that are not feasible, by their fallback ranking.
        enough: bool ``[b]``, rows whose search ends here with the best that was found: it needs no improvement, or time
            is up. None of them when ``None``.
    """

    score: Tensor
    feasible: Tensor
    fallback: Tensor
    restart: Tensor | None = None
    enough: Tensor | None = None


class ScorePlans(Protocol):
    """Rates candidate sequences."""

    def __call__(self, actions: Tensor, rows: Tensor, restarts: Tensor, iteration: int) -> PlanScores:
        """Rate ``actions`` ``[b, N, H, A]`` of batch rows ``rows`` ``[b]``, restarted ``restarts`` ``[b]`` times."""


#: Where an optimiser takes its noise from: (rows ``[b]``, iteration) -> what :meth:`Optimizer.sample_noise` returns.
NoiseSource = Callable[[Tensor, int], tuple[Tensor, ...]]


class OptimizerResult(NamedTuple):
    """The outcome for B rows.

    Attributes:
        actions: the sequence to act on, ``[B, H, A]``.
        score: its score, ``[B]``; for a fallback its fallback ranking.
        mean: mean of the Gaussian that the search ended with, ``[B, H, A]``; the next step's warm start.
        std: its standard deviation, ``[B, H, A]``.
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


@runtime_checkable
class Optimizer(Protocol):
    """A search for the best feasible action sequence in a box, for a batch of independent rows.

    :class:`~ls3_torchrl.planners.CrossEntropyMethod` is one. Any object with these members takes its place in
    :class:`~ls3_torchrl.planners.LS3Planner`; nothing has to be inherited. It knows no model: it proposes sequences,
    and the planner's ``score_plans`` says what they are worth and whether they may be carried out.
    """

    @property
    def num_candidates(self) -> int:
        """N, how many sequences are scored together in one iteration."""

    @property
    def uses_warm_start(self) -> bool:
        """Whether the Gaussian that a search starts from matters; if not, the last plan need not be carried on."""

    def max_iterations(self, max_restarts: int) -> int:
        """The most iterations that one call can score: noise for so many makes a plan repeatable."""

    def sample_noise(self, rows: Tensor, horizon: int, action_dim: int) -> tuple[Tensor, ...]:
        """Fresh noise for one iteration of ``rows`` ``[b]``: any number of tensors, each ``[b, ...]``."""

    def __call__(
        self,
        score_plans: ScorePlans,
        low: Tensor,
        high: Tensor,
        *,
        batch: int,
        horizon: int,
        max_restarts: int,
        mean: Tensor | None = None,
        std: Tensor | None = None,
        noise: NoiseSource | None = None,
    ) -> OptimizerResult:
        """Optimise ``batch`` sequences of ``horizon`` actions in the box, in float32.

        Args:
            score_plans: rates candidates. It is called with the rows that are still searched, how often each has
                started again, and the number of the iteration, which counts up from 0 over all restarts.
            low: lower bounds ``[A]``.
            high: upper bounds ``[A]``.
            batch: B; 0 is allowed.
            horizon: H.
            max_restarts: how often a row that ``score_plans`` wants to start again may do so: each time the planner
                relaxes its safe set for that row.
            mean: mean of the Gaussian to start from, ``[B, H, A]``; the box's middle when ``None``.
            std: its standard deviation; a quarter of the box's side when ``None``.
            noise: where noise comes from; :meth:`sample_noise` when ``None``.
        """
