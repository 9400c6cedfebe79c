"""LearnerGroup: learners one after another, or side by side on the cores that there are, with the same results."""

from __future__ import annotations

import math
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import torch

from ls3_torchrl.trainers.learner import Learner
from ls3_torchrl.trainers.processes import Processes, Report, Sender
from ls3_torchrl.trainers.progress import Bar, progress_bar
from ls3_torchrl.trainers.steps import new_seed
from ls3_torchrl.trainers.together import can_train_together, train_together

#: A learner's name, its gradient steps, and what they are shown as.
Stage: TypeAlias = tuple[str, int, str]
#: Numbers of stages whose learners take their steps together; and what is trained in this order.
Unit: TypeAlias = tuple[int, ...]
Chain: TypeAlias = list[Unit]
#: Gradient steps below which a process costs more than it gains.
_WORTH_A_PROCESS = 200
#: Seconds between two states of what is trained in other processes, which ``after_step`` is called with.
_INTERVAL = 2.0
#: What PyTorch says to a gradient in a fork of a process whose autograd has threads.
_AFTER_FORK = "autograd's threading in combination with fork"
#: How many parameters take as long as the rest of a step.
_PARAMETERS = 100_000
#: What a process that is nicer by one gets less of a core it shares: the scheduler's weights are powers of it.
_NICE = 1.25


class LearnerGroup:
    """Learners that are trained by a list of stages, and continue where a state of them was taken.

    Learners that are independent (:attr:`Learner.is_independent <ls3_torchrl.trainers.Learner.is_independent>`) and
    share no network are trained side by side, in forked processes on as many cores as PyTorch computes on
    (``torch.set_num_threads``); the stages of all others keep their order. Every stage has a seed, drawn before the
    first one begins: how many cores there are changes nothing in the results. Where there is one core, an accelerator,
    or another system than Linux, one learner is trained after another.

    Side by side, ``after_step`` of the learners is called every two seconds instead of after every step.

    Args:
        learners: by name.

    Example:
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import GoalEstimator
        >>> from ls3_torchrl.objectives import ClassifierLoss
        >>> reached = {"latent": torch.zeros(4, 8), "success": torch.ones(4, 1, dtype=torch.bool)}
        >>> batch = TensorDict({"next": reached}, [4])
        >>> goal = Learner("goal", ClassifierLoss(GoalEstimator(8)), lambda: batch, lr=1e-3, progress=False)
        >>> group = LearnerGroup({"goal": goal})
        >>> group.train([("goal", 3, "Goal"), ("goal", 2, "Goal again")])
        >>> goal.steps
        5
    """

    def __init__(self, learners: Mapping[str, Learner]) -> None:
        self.learners = dict(learners)
        self._stages: list[Stage] = []  # the list that train() is in
        self._seeds: list[int | None] = []  # of the stages
        self._finished: list[int] = []  # which of them

    def train(self, stages: Iterable[Stage]) -> None:
        """Train by a list of stages; after :meth:`load_state_dict`, what is left of the list that was being trained.

        Raises:
            DivergenceError: when a loss or a gradient is not finite.
            RuntimeError: for another list than the one that was being trained.
        """
        wanted = list(stages)
        if self._stages and wanted != self._stages:
            raise RuntimeError(
                f"The state was taken in the middle of other training, of {self._stages} with "
                f"{len(self._finished)} of {len(self._stages)} done; now {wanted} is asked for. Call first what was "
                "being called then."
            )
        if not self._stages:
            seeds = [new_seed() if self.learners[name].streams else None for name, _, _ in wanted]
            self._stages, self._seeds = wanted, seeds
        chains = [chain for chain in self._chains() if all(self._learner(i).is_independent for i in _flat(chain))]
        if (
            min(len(chains), torch.get_num_threads()) > 1
            and self._steps(chains) >= _WORTH_A_PROCESS
            and _may_fork(self.learners.values())
        ):
            self._train_side_by_side(chains)
        for unit in self._units():
            self._train_here(unit)
        self._stages, self._seeds, self._finished = [], [], []

    def _train_here(self, unit: Unit) -> None:
        """Train one learner, or several together."""
        learners, (_, steps, phase) = [self._learner(i) for i in unit], self._stages[unit[0]]
        if len(unit) == 1:
            learners[0].train(steps, phase, seed=self._seeds[unit[0]])
        else:
            callbacks = _callbacks(learners)
            total, shown = steps * len(unit), any(learner.progress for learner in learners)
            done = sum(self._steps_done(i) for i in unit)
            with progress_bar(total, ", ".join(self._stages[i][2] for i in unit), done=done, enabled=shown) as bar:
                self._take_steps(unit, [bar] * len(unit), lambda: [callback() for callback in callbacks])
        self._finished += unit

    def _take_steps(self, unit: Unit, bars: Sequence[Bar], after_step: Callable[[], object]) -> None:
        learners, (_, steps, phase) = [self._learner(i) for i in unit], self._stages[unit[0]]
        seeds = [self._seeds[i] for i in unit]
        if len(unit) == 1:
            learners[0].take_steps(steps, phase, bars[0], seed=seeds[0], after_step=after_step)
        else:
            train_together(learners, steps, [self._stages[i][2] for i in unit], bars, seeds, after_step)

    def _steps_done(self, index: int) -> int:
        name, steps, phase = self._stages[index]
        return self.learners[name].steps_done(steps, phase)

    def _units(self) -> list[Unit]:
        """The stages that are left, those in one where learners can take their steps together."""
        units: list[Unit] = []
        for i, (name, steps, _) in enumerate(self._stages):
            if i in self._finished:
                continue
            before = [self._learner(k) for k in units[-1]] if units and self._stages[units[-1][0]][1] == steps else []
            learner = self.learners[name]
            if before and learner not in before and can_train_together([*before, learner]):
                units[-1] = (*units[-1], i)
            else:
                units.append((i,))
        return units

    def _learner(self, index: int) -> Learner:
        """Of a stage."""
        return self.learners[self._stages[index][0]]

    def _steps(self, chains: Iterable[Chain]) -> int:
        return sum(self._stages[i][1] for chain in chains for i in _flat(chain))

    def _chains(self) -> list[Chain]:
        """What is left, in lists of which none shares a network with another."""
        chains: list[tuple[set[int], Chain]] = []
        for unit in self._units():
            touched, mine = set().union(*(_tensors(self._learner(i)) for i in unit)), [unit]
            for other in [chain for chain in chains if chain[0] & touched]:
                touched, mine = touched | other[0], other[1] + mine
                chains.remove(other)
            chains.append((touched, mine))
        return [sorted(chain) for _, chain in chains]

    def _train_side_by_side(self, chains: Sequence[Chain]) -> None:
        """Train chains in processes."""
        work = [sum(self._work(i) for i in _flat(chain)) for chain in chains]
        crowded = len(chains) > torch.get_num_threads()
        # Where they share cores, each gets a share by its work, and all end at about the same time.
        nice = [round(math.log(max(work) / own, _NICE)) if crowded else 0 for own in work]
        involved = [self._learner(i) for chain in chains for i in _flat(chain)]
        callbacks = _callbacks(involved)
        done = sum(self._steps_done(i) for chain in chains for i in chain[0])
        shown = any(learner.progress for learner in involved)
        with (
            progress_bar(self._steps(chains), "Learning", done=done, enabled=shown) as bar,
            Processes(self._train_chain, chains, nice) as processes,
        ):
            last = time.monotonic()
            for report in processes.reports():
                if report is None:  # now and then
                    if time.monotonic() - last > _INTERVAL:
                        processes.ask_for_states()
                        last = time.monotonic()
                    continue
                if _AFTER_FORK in str(report.error):
                    return  # all is trained here, from before the step that failed
                bar.update(report.steps)
                if report.text:
                    bar.set_postfix_str(report.text, refresh=False)
                for name, metric, value, step in report.scalars:
                    self.learners[name].logger.log_scalar(metric, value, step=step)  # type: ignore[union-attr]
                if report.state is not None:
                    self._load(report.state)
                if report.error is not None:
                    raise report.error
                if report.all_states:
                    for callback in callbacks:
                        callback()

    def _work(self, index: int) -> float:
        """About how much a stage takes, compared with others."""
        parameters = sum(parameter.numel() for parameter in self._learner(index).parameters)
        return max(self._stages[index][1], 1) * (parameters + _PARAMETERS)

    def _train_chain(self, chain: Chain, send: Callable[[Report], bool]) -> None:
        """Train a chain in a process of its own."""
        finished: list[int] = []
        names = list(dict.fromkeys(self._stages[i][0] for i in _flat(chain)))

        def state() -> dict[str, Any]:
            return {"finished": list(finished), "learners": {n: self.learners[n].state_dict() for n in names}}

        sender = Sender(send, state)
        try:
            for unit in chain:
                for i in unit:
                    learner = self._learner(i)
                    learner.logger = None if learner.logger is None else sender.of(self._stages[i][0])  # type: ignore[assignment]
                bars = [sender.of(self._stages[i][2]) for i in unit]
                self._take_steps(unit, bars, sender.now_and_then)
                finished += unit
        except Exception as error:
            sender.send_state(error)
        else:
            sender.send_state()

    def _load(self, state: Mapping[str, Any]) -> None:
        """Take over what a process has trained."""
        for name, learner_state in state["learners"].items():
            self.learners[name].load_state_dict(learner_state)
        self._finished += [i for i in state["finished"] if i not in self._finished]

    def state_dict(self) -> dict[str, Any]:
        """That of every learner, and how far the list of stages was carried out."""
        learners = {name: learner.state_dict() for name, learner in self.learners.items()}
        stages = {"stages": list(self._stages), "seeds": list(self._seeds), "finished": sorted(self._finished)}
        return stages | learners

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken."""
        self._stages, self._seeds = list(state_dict["stages"]), list(state_dict["seeds"])
        self._finished = list(state_dict["finished"])
        for name, learner in self.learners.items():
            learner.load_state_dict(state_dict[name])


def _flat(chain: Chain) -> list[int]:
    return [i for unit in chain for i in unit]


def _callbacks(learners: Iterable[Learner]) -> list[Callable[[], object]]:
    return list(dict.fromkeys(one.after_step for one in learners if one.after_step is not None))


def _tensors(learner: Learner) -> set[int]:
    """Marks of what a learner reads or writes that another may as well: its tensors, and PyTorch's random numbers."""
    tensors = {id(tensor) for tensor in (*learner.loss.parameters(), *learner.loss.buffers())}
    return tensors if learner.is_independent else {*tensors, 0}


def _may_fork(learners: Iterable[Learner]) -> bool:
    """Whether a forked process can train: on Linux, without an accelerator, whose threads a fork would lose.

    Daemons may not have processes.
    """
    if multiprocessing.current_process().daemon:
        return False
    devices = {parameter.device.type for learner in learners for parameter in learner.parameters}
    return sys.platform == "linux" and devices == {"cpu"} and not torch.accelerator.is_available()
