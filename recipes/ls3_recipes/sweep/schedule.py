"""Carries out the jobs of a sweep: each when what it needs is there, and none because another one failed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path

from tqdm import tqdm

from ls3_recipes.console import console
from ls3_recipes.interrupts import Interrupts
from ls3_recipes.sweep.index import (
    CUT_OFF,
    FAILED,
    FINISHED,
    NOT_BEGUN,
    NOT_NEEDED,
    RUNNING,
    WAITING,
    Index,
    outcome_of,
)
from ls3_recipes.sweep.jobs import Job
from ls3_recipes.sweep.launchers import Launcher
from ls3_recipes.sweep.task import Task

#: Seconds between two looks at whether a signal has come.
_PATIENCE = 1.0
#: Bytes at the end of a log in which the reason of a failure is looked for.
_TAIL = 20_000


class Schedule:
    """Begins jobs in their order, as many at a time as the launcher takes.

    Args:
        jobs: by name, each after those that it needs.
        index: gets every change of state.
        launcher: carries them out.
        logs: the folder of their logs.
        files: a user's folder of settings, or nothing.
    """

    def __init__(self, jobs: Mapping[str, Job], index: Index, launcher: Launcher, logs: Path, files: str) -> None:
        self._jobs, self._index, self._launcher = jobs, index, launcher
        self._logs, self._files = logs.absolute(), files
        self._running: dict[Future[int], Job] = {}

    def carry_out(self, interrupts: Interrupts) -> None:
        """Carry out what is left of all jobs.

        Raises:
            Interrupted: for Ctrl-C, SIGTERM or SIGHUP, when all that was under way has saved its state.
        """
        states = {job.name: FINISHED for job in self._jobs.values() if job.is_done()}
        states |= dict.fromkeys(self._needless(states), NOT_NEEDED)
        self._index.set(states)
        bar = tqdm(total=len(self._jobs), initial=len(states), desc=f"{'Sweep':<24}", unit="job")
        try:
            with interrupts.deferred():
                while self._begin() or self._running:
                    for future in wait(self._running, _PATIENCE, FIRST_COMPLETED).done:
                        self._end(self._running.pop(future), future)
                        bar.update()
                    if interrupts.pending:
                        break
                if interrupts.pending:
                    self._launcher.stop()
                    self._index.set({job.name: CUT_OFF for job in self._running.values()})
        finally:
            bar.close()

    def _needless(self, done: Mapping[str, str]) -> list[str]:
        """Data and VAEs that nothing is left to be made from: they may have been deleted since."""
        needed: set[str] = set()
        for job in reversed([*self._jobs.values()]):
            if job.name not in done and (job.kind in ("train", "rollouts") or job.name in needed):
                needed |= {*job.needs}
        shared = [job.name for job in self._jobs.values() if job.kind in ("data", "vae")]
        return [name for name in shared if name not in done and name not in needed]

    def _begin(self) -> bool:
        """Begin what can begin; whether anything may still begin later."""
        states = self._index.states
        for job in self._jobs.values():
            if states[job.name] != WAITING:
                continue
            needs = {states[name] for name in job.needs}
            if needs & {FAILED, NOT_BEGUN}:
                lacks = next(name for name in job.needs if states[name] in (FAILED, NOT_BEGUN))
                self._index.set({job.name: NOT_BEGUN}, {job.name: f"{lacks} failed"})
            elif needs <= {FINISHED} and len(self._running) < self._launcher.slots:
                self._running[self._launcher.submit(self._task(job))] = job
                self._index.set({job.name: RUNNING})
        return WAITING in states.values()

    def _task(self, job: Job) -> Task:
        arguments = (job.kind, str(job.folder.absolute()), self._files, *job.arguments)
        return Task(arguments, str(self.log_of(job)), os.getcwd())

    def log_of(self, job: Job) -> Path:
        """What a job has said."""
        return self._logs / f"{job.name}.log"

    def _end(self, job: Job, future: Future[int]) -> None:
        """Take note of how a job ended."""
        error = future.exception()
        status = None if error else future.result()
        if status == 0 and job.is_done():
            self._index.set({job.name: FINISHED})
            shown = " ".join(f"{name} {value}" for name, value in outcome_of(job).items())
            console.print(f"  {job.name}: finished. {shown}", markup=False, highlight=False, soft_wrap=True)
            return
        reason = " ".join(str(error).split())[:300] if error else self._reason(job, status)
        self._index.set({job.name: FAILED}, {job.name: reason})
        console.print(f"  {job.name}: failed. {reason}", markup=False, highlight=False, soft_wrap=True)

    def _reason(self, job: Job, status: int | None) -> str:
        """The last line of a log, and how the process ended where that was not its own decision."""
        text = self.log_of(job).read_bytes()[-_TAIL:].decode(errors="replace") if self.log_of(job).is_file() else ""
        lines = [line.strip() for line in text.replace("\r", "\n").splitlines() if line.strip()]
        said = lines[-1][:300] if lines else ""
        return f"ended by signal {-status}: {said}" if status is not None and status < 0 else said or f"status {status}"
