"""Forked processes that train, and report to the one that they were forked from."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any

import torch

#: Seconds without a word after which a process is given up, and between looks at those that are silent.
_SILENCE, _TICK = 120.0, 0.2
_STATE = "state"


@dataclass
class Report:
    """What a process says.

    Attributes:
        steps: taken since the last report.
        text: how it goes.
        scalars: metrics to log, those between two states: whose they are, their name, their value and the step.
        state: of what it trains.
        error: that ended it.
        all_states: whether with this one every process has sent the state that it was asked for.
    """

    steps: int = 0
    text: str = ""
    scalars: list[tuple[str, str, float, int]] = field(default_factory=list)
    state: dict[str, Any] | None = None
    error: Exception | None = None
    all_states: bool = False


class _Worker:
    """A process, and whether it is still at work."""

    def __init__(self, process: Any, connection: Connection) -> None:
        self.process, self.connection = process, connection
        self.busy, self.silence = True, 0.0  # seconds that were waited for a word


class Processes:
    """Carries out tasks in forked processes, one for each.

    A process knows everything that there was when it was forked, and nothing that it changes is seen outside except by
    its reports. One that dies, or says nothing for two minutes, is given up with a warning, and its task stays undone.

    Args:
        target: carries out a task, and calls what it is given with reports; that returns whether a state is asked for.
            The last report of a task has a state.
        tasks: what it is called with.
        nice: of each process; where there are more processes than cores, those of higher numbers get less time.
    """

    def __init__(
        self, target: Callable[[Any, Callable[[Report], bool]], None], tasks: Sequence[Any], nice: Sequence[int]
    ) -> None:
        self._target = target
        self._asked: set[_Worker] = set()  # whose states are awaited
        context = multiprocessing.get_context("fork")
        self._workers: list[_Worker] = []
        try:
            for task, number in zip(tasks, nice, strict=True):
                ours, theirs = context.Pipe()
                # A process has copies of these ends. With them it would wait for itself when nobody else is there.
                others = [ours, *(worker.connection for worker in self._workers)]
                args = (task, number, theirs, others, os.getpid())
                process = context.Process(target=self._work, args=args, daemon=True)
                with warnings.catch_warnings():
                    # Later Pythons warn of locks that other threads hold. These are idle, and silence is waited out.
                    warnings.simplefilter("ignore", DeprecationWarning)
                    process.start()
                theirs.close()
                self._workers.append(_Worker(process, ours))
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        """End all of them."""
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join()
            worker.connection.close()

    def ask_for_states(self) -> None:
        """Let every process that works send a state between two steps; nothing where some are still awaited."""
        if self._asked:
            return
        for worker in self._workers:
            if worker.busy:
                self._asked.add(worker)
                with suppress(OSError):  # it is dead, as the next look at it will tell
                    worker.connection.send(_STATE)

    def reports(self) -> Iterator[Report | None]:
        """What the processes say until all tasks are done, and ``None`` now and then when they are silent."""
        while busy := {worker.connection: worker for worker in self._workers if worker.busy}:
            spoken = [busy[connection] for connection in wait(list(busy), _TICK)]  # type: ignore[index]
            for worker in spoken:
                if (report := self._hear(worker)) is not None:
                    yield report
            for worker in set(busy.values()) - set(spoken):
                # Not by the clock: it goes on while all of them are stopped.
                worker.silence += _TICK if not spoken else 0.0
                if worker.silence > _SILENCE:
                    self._give_up(worker)
            yield None

    def _hear(self, worker: _Worker) -> Report | None:
        try:
            report, done = pickle.loads(worker.connection.recv_bytes())
        except (EOFError, OSError):
            self._give_up(worker)
            return None
        worker.silence = 0.0
        if report.state is not None and worker in self._asked:
            self._asked.remove(worker)
            report.all_states = not self._asked
        if done:
            worker.busy = False
            self._asked.discard(worker)  # asked too late
        return report

    def _give_up(self, worker: _Worker) -> None:
        warnings.warn(
            f"A process that trained has ended or fallen silent (exit code {worker.process.exitcode}); what it trained "
            "is trained again, one learner after another. The results stay the same. Was memory short?",
            RuntimeWarning,
            stacklevel=4,
        )
        self._asked.discard(worker)
        worker.busy = False
        worker.process.kill()

    def _work(self, task: Any, nice: int, connection: Connection, others: Sequence[Connection], parent: int) -> None:
        """What a process does."""
        for other in others:
            other.close()
        os.nice(nice)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            # A terminal sends Ctrl-C to all, a service manager SIGTERM; who has forked this process ends it.
            signal.signal(number, signal.SIG_IGN)
        torch.set_num_threads(1)
        try:
            self._target(task, _Channel(connection, parent).send)
            connection.send_bytes(pickle.dumps((Report(), True)))
            connection.recv()  # until all have ended, or there is nobody to end them
        except (EOFError, OSError):
            pass  # nobody listens any more
        except BaseException:
            traceback.print_exc()
            raise


class _Channel:
    """A process's way to the one that has forked it."""

    def __init__(self, connection: Connection, parent: int) -> None:
        self._connection, self._parent = connection, parent

    def send(self, report: Report) -> bool:
        """Send a report; whether a state is asked for."""
        if os.getppid() != self._parent:
            os._exit(1)  # nobody will come for what is trained here
        self._connection.send_bytes(pickle.dumps((report, False)))
        asked = False
        while self._connection.poll():
            asked |= self._connection.recv() == _STATE
        return asked


class Sender:
    """In a process, reports what happens in the course of a task.

    Args:
        send: sends a report; whether a state is asked for.
        state: makes the state.
    """

    def __init__(self, send: Callable[[Report], bool], state: Callable[[], dict[str, Any]]) -> None:
        self._send, self._state = send, state
        self.report, self._sent = Report(), time.monotonic()
        #: Metrics since the last state. They are sent with the next: what is trained again after it is logged once.
        self.scalars: list[tuple[str, str, float, int]] = []

    def of(self, name: str) -> Voice:
        """The progress bar or the logger of one learner."""
        return Voice(self, name)

    def now_and_then(self) -> None:
        """Report, after a step, when some time has passed, and the state as well where it is asked for."""
        if time.monotonic() - self._sent > _TICK:
            asked = self._send(self.report)
            self.report, self._sent = Report(), time.monotonic()
            if asked:
                self.send_state()

    def send_state(self, error: Exception | None = None) -> None:
        """Report a state, and what has happened since the last."""
        self.report.scalars, self.scalars = self.scalars, []
        self.report.state, self.report.error = self._state(), error
        self._send(self.report)
        self.report = Report()


class Voice:
    """What a learner takes for its progress bar and its logger.

    Args:
        sender: through which it is reported.
        name: of the phase or the learner.
    """

    def __init__(self, sender: Sender, name: str) -> None:
        self._sender, self._name = sender, name

    def update(self, n: int = 1) -> None:
        """``n`` more steps were taken."""
        self._sender.report.steps += n

    def set_postfix_str(self, s: str, refresh: bool = True) -> None:
        """Say how it goes."""
        self._sender.report.text = f"{self._name}: {s}"

    def log_scalar(self, name: str, value: float, step: int | None = None, **_: Any) -> None:
        """A metric."""
        self._sender.scalars.append((self._name, name, value, step or 0))
