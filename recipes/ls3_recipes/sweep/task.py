"""A job of a sweep as a process of its own: whatever becomes of it, the others go on."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Task:
    """What a process is to do, wherever it is started.

    Args:
        arguments: of :mod:`ls3_recipes.sweep.worker`.
        log: the file that its output goes behind.
        folder: its working directory.
    """

    arguments: tuple[str, ...]
    log: str
    folder: str


def start(task: Task, threads: int) -> subprocess.Popen:
    """Start a task; it ends with this process, and Ctrl-C does not reach it.

    Args:
        task: what to do.
        threads: for each of its operations, and cores for its processes.
    """
    own = {
        "OMP_NUM_THREADS": str(threads),
        "OMP_WAIT_POLICY": "passive",
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
    }
    command = [sys.executable, "-m", "ls3_recipes.sweep.worker", str(os.getpid()), *task.arguments]
    Path(task.log).parent.mkdir(parents=True, exist_ok=True)
    with Path(task.log).open("ab") as log:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            cwd=task.folder,
            env=os.environ | own,
            start_new_session=True,
        )


def carry_out(task: Task, threads: int) -> int:
    """Carry out a task from its start to its end; returns its exit status."""
    process = start(task, threads)
    try:
        return process.wait()
    except BaseException:  # asked to stop: it saves its state
        process.terminate()
        process.wait()
        raise
