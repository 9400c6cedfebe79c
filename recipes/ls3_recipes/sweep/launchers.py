"""Where the jobs of a sweep are carried out: on this machine, by Ray, or by Slurm."""

from __future__ import annotations

import os
import shutil
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import Popen
from typing import Any

from ls3_envs.cores import available_cores
from ls3_recipes.options import build
from ls3_recipes.sweep.task import Task, carry_out, start
from ls3_torchrl._values import require_at_least, require_choice


class Launcher(ABC):
    """Carries out tasks."""

    #: Tasks at a time; more would only wait here instead of there.
    slots: int

    @abstractmethod
    def submit(self, task: Task) -> Future[int]:
        """Begin a task, or queue it; its exit status comes as the future's result."""

    @abstractmethod
    def stop(self) -> None:
        """Tell what is under way to save its state and end, and wait for that."""

    def close(self) -> None:  # noqa: B027
        """Give back what was started, when nothing is under way any more."""


@dataclass(kw_only=True)
class Local(Launcher):
    """Processes on this machine; each has cores of its own.

    Args:
        workers: runs at a time; 1 carries them out in turn. As many as cores when ``None``.
        threads: of each; its share of the cores when ``None``.
    """

    workers: int | None = None
    threads: int | None = None
    _running: dict[Popen, set[int]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        """Share out the cores."""
        cores = available_cores()
        if self.workers is not None:
            require_at_least(self.workers, 1, "workers")
        if self.threads is not None:
            require_at_least(self.threads, 1, "threads")
        self.slots = self.workers or max(1, cores // (self.threads or 1))
        self._threads = self.threads or max(1, cores // self.slots)
        self._free = self._shares()

    def _shares(self) -> list[set[int]]:
        """The cores of each worker; none where they cannot be chosen, or the workers do not take just all of them.

        Where cores are left, another sweep would choose the same ones.
        """
        if not hasattr(os, "sched_setaffinity"):  # on macOS and Windows
            return [set() for _ in range(self.slots)]
        cores = sorted(os.sched_getaffinity(0))
        if len(cores) != self.slots * self._threads:
            return [set() for _ in range(self.slots)]
        return [set(cores[i * self._threads : (i + 1) * self._threads]) for i in range(self.slots)]

    def submit(self, task: Task) -> Future[int]:
        """Start a process."""
        process, cores, future = start(task, self._threads), self._free.pop(), Future[int]()
        if cores:
            os.sched_setaffinity(process.pid, cores)
        self._running[process] = cores

        def wait() -> None:
            status = process.wait()
            self._free.append(self._running.pop(process))
            future.set_result(status)

        threading.Thread(target=wait, daemon=True).start()
        return future

    def stop(self) -> None:
        """Send SIGTERM to all."""
        running = [*self._running]
        for process in running:
            process.terminate()
        for process in running:
            process.wait()


@dataclass(kw_only=True)
class Ray(Launcher):
    """Tasks of a Ray cluster, all of whose nodes see the same folders.

    Args:
        address: of a cluster; ``None`` for one that Ray finds, or else one on this machine that is started, and ends
            with the sweep.
        threads: CPUs of each run.
        num_cpus: start one with so many, whether there is another or not.
        num_gpus: of each run.
    """

    address: str | None = None
    threads: int = 1
    num_cpus: int | None = None
    num_gpus: float = 0.0

    def __post_init__(self) -> None:
        """Connect."""
        require_at_least(self.threads, 1, "threads")
        try:
            import ray
        except ModuleNotFoundError:
            raise ModuleNotFoundError("hydra/launcher=ray needs Ray: pip install ray.", name="ray") from None
        self._ray, self._refs = ray, {}  # type: ignore[var-annotated]
        quiet: dict[str, Any] = {
            "log_to_driver": False,
            "configure_logging": False,
        }  # what is said is in the jobs' logs
        try:
            if self.num_cpus is not None:
                raise ConnectionError
            ray.init(address=self.address or "auto", **quiet)
        except ConnectionError:
            if self.address is not None:
                raise
            ray.init(address="local", num_cpus=self.num_cpus, include_dashboard=False, **quiet)
        self.slots = max(1, int(ray.cluster_resources().get("CPU", 1)) // self.threads)
        needs: dict[str, Any] = {"num_cpus": self.threads, "num_gpus": self.num_gpus, "max_retries": 0}
        self._carry_out: Any = ray.remote(**needs)(carry_out)

    def submit(self, task: Task) -> Future[int]:
        """Queue a task."""
        ref = self._carry_out.remote(task, self.threads)
        future: Future[int] = ref.future()
        self._refs[future] = ref
        return future

    def stop(self) -> None:
        """Cancel all, and end a cluster that was started."""
        for future, ref in self._refs.items():
            if not future.done():
                self._ray.cancel(ref)
        if self._refs:
            self._ray.wait([*self._refs.values()], num_returns=len(self._refs), timeout=120.0)
        self.close()

    def close(self) -> None:
        """End a cluster that was started, and leave another."""
        self._ray.shutdown()


@dataclass(kw_only=True)
class Slurm(Launcher):
    """Jobs of a Slurm cluster, submitted by submitit.

    Args:
        folder: for submitit's files; below the sweep's folder.
        threads: CPUs of each job.
        hours: that a job may take; what is cut off then goes on when the sweep is started again.
        partition: of the cluster.
        gpus: of each job.
        memory_gb: of each job.
        parameters: further ones of ``submitit.AutoExecutor.update_parameters``, such as ``slurm_account``.
        cluster: ``"slurm"``, or ``"local"`` to try it without one.
    """

    folder: str
    threads: int = 4
    hours: float = 24.0
    partition: str | None = None
    gpus: int = 0
    memory_gb: float | None = None
    parameters: Any = field(default_factory=dict)
    cluster: str = "slurm"

    def __post_init__(self) -> None:
        """Prepare the submissions."""
        require_at_least(self.threads, 1, "threads")
        if not isinstance(self.parameters, Mapping):
            raise TypeError(
                f"parameters must be names with values, such as {{slurm_account: NAME}}; got {self.parameters!r}."
            )
        try:
            import submitit
        except ModuleNotFoundError:
            message = "hydra/launcher=slurm needs submitit: pip install submitit."
            raise ModuleNotFoundError(message, name="submitit") from None
        if self.cluster == "slurm" and shutil.which("srun") is None:
            raise ValueError(
                "hydra/launcher=slurm submits jobs, but this machine has no srun. Start the sweep on a node of the "
                "cluster that does, or try it with hydra.launcher.cluster=local."
            )
        self.slots = 100_000  # Slurm has a queue of its own
        self._jobs: dict[Future[int], Any] = {}
        self._executor = submitit.AutoExecutor(folder=Path(self.folder), cluster=self.cluster)
        chosen = {"slurm_partition": self.partition, "mem_gb": self.memory_gb, "gpus_per_node": self.gpus or None}
        self._executor.update_parameters(
            name="ls3-sweep",
            timeout_min=int(60 * self.hours),
            cpus_per_task=self.threads,
            **{name: value for name, value in chosen.items() if value is not None},
            **self.parameters,
        )

    def submit(self, task: Task) -> Future[int]:
        """Submit a job."""
        job = self._executor.submit(carry_out, task, self.threads)
        future = _in_thread(job.result)
        self._jobs[future] = job
        return future

    def stop(self) -> None:
        """Cancel all."""
        for future, job in self._jobs.items():
            if not future.done():
                job.cancel()


def _in_thread(wait: Callable[[], int]) -> Future[int]:
    """What a blocking call will return."""
    future = Future[int]()

    def run() -> None:
        try:
            future.set_result(wait())
        except BaseException as error:  # whatever the job ended with
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future


#: By the names of the files in ``conf/hydra/launcher``.
LAUNCHERS: dict[str, type[Launcher]] = {"local": Local, "ray": Ray, "slurm": Slurm}


def make_launcher(chosen: Mapping[str, Any] | None, output: Path) -> Launcher:
    """What ``hydra/launcher`` and ``hydra.launcher`` choose.

    Args:
        chosen: ``name``, and settings of that launcher; processes on this machine when ``None``.
        output: the sweep's folder.

    Raises:
        ValueError: for an unknown launcher or setting.
    """
    settings = dict(chosen or {"name": "local"})
    class_ = LAUNCHERS[require_choice(settings.pop("name", ""), LAUNCHERS, "hydra/launcher")]
    if class_ is Slurm:
        settings.setdefault("folder", str(output.absolute() / "logs" / "slurm"))
    return build(class_, settings, "hydra.launcher")
