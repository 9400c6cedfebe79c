"""Learners whose networks have one shape, trained together as one stacked network."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Tensor

from ls3_torchrl.objectives.head import StackedHeads
from ls3_torchrl.trainers.learner import Learner
from ls3_torchrl.trainers.progress import Bar
from ls3_torchrl.trainers.steps import is_finite, set_gradients, threads


def can_train_together(learners: Sequence[Learner]) -> bool:
    """Whether learners can take the same steps at once: losses of networks of one shape, computed in one precision."""
    plain = all(type(one) is Learner and one.is_independent and one.optimizer is not None for one in learners)
    if not plain or len({_kind(learner) for learner in learners}) > 1:
        return False
    parameters = [id(parameter) for learner in learners for parameter in learner.loss.parameters()]
    return len(parameters) == len(set(parameters)) and StackedHeads.can_stack([learner.loss for learner in learners])  # type: ignore[misc]


def _kind(learner: Learner) -> tuple[object, ...]:
    """What learners must have in common."""
    (batches,) = learner.streams
    size = batches.batch_size, batches.members, batches.selection.steps
    return learner.bf16, learner.phase_steps, learner.parameters[0].device, size


def train_together(
    learners: Sequence[Learner],
    steps: int,
    phases: Sequence[str],
    bars: Sequence[Bar],
    seeds: Sequence[int | None],
    after_step: Callable[[], object] | None,
) -> None:
    """What :meth:`Learner.take_steps <ls3_torchrl.trainers.Learner.take_steps>` does, for several at once.

    Every learner has batches, optimiser, lagged network and metrics of its own.

    Raises:
        DivergenceError: of the first learner whose loss or gradient is not finite; none has taken that step.
    """
    for learner, phase, seed in zip(learners, phases, seeds, strict=True):
        learner.begin(steps, phase, seed)
    heads = StackedHeads([learner.loss for learner in learners])  # type: ignore[misc]
    parameters = [parameter for learner in learners for parameter in learner.parameters]
    with threads(1):
        while learners[0].phase_steps < steps:
            batches = [learner.new_batch() for learner in learners]
            with learners[0].autocast():
                losses = heads.losses(batches)
                values = [found[f"loss_{one.names[0]}"] for one, found in zip(learners, losses, strict=True)]
                total: Tensor = sum(values)  # type: ignore[assignment]
            if not set_gradients(parameters, total):
                wrong = [i for i, one in enumerate(learners) if not is_finite(one.parameters, values[i])]
                first = wrong[0] if wrong else 0
                raise learners[first].divergence(losses[first])
            for learner, found, value, bar in zip(learners, losses, values, bars, strict=True):
                learner.step(found, value, bar)
            if after_step is not None:
                after_step()
    for learner in learners:
        learner.end()
