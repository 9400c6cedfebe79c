"""Whole runs on tiny networks in processes of their own, that can be ended at any moment and compared afterwards."""

import csv
import json
import multiprocessing
import os
import signal
import time
from pathlib import Path

import torch

# Processes are forked from one that has imported everything and done nothing: a run begins at once.
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["tiny_runs", "ls3_recipes.protocol", "ls3_recipes.commands.train"])

TINY = ["preset=smoke", "device=cpu", "threads=1", "vae.autocast=false", "pictures=false"]
LS3 = [*TINY, "optim.autocast=false", "planner.precision=fp32"]
#: In which every step of training is followed by a save.
ALWAYS = "checkpoint_minutes=1e-9"
#: What a run of LS³ does, as :attr:`Run.phase` calls it.
PHASES = ["demonstrations", "VAE", "encoding", "Dynamics", "Value, reward-to-go", "Value, TD-1", "Safe set"]
PHASES += ["Constraint", "Goal", "saving", "planning", "keeping episodes", "evaluation"]
#: Of a summary, what tells of the clock.
CLOCK = ("minutes", "seconds", "cpu_utilisation")


class Moment:
    """When a process ends itself: at the n-th call of what brings files to the disk.

    Args:
        call: its number, from 1.
        how: called then.
    """

    def __init__(self, call, how):
        self.call, self.how = call, how

    def arm(self):
        """Count the calls from now on."""
        self.calls = 0

        def counted(function):
            def call(*args, **kwargs):
                self.calls += 1
                if self.calls == self.call:
                    self.how()
                return function(*args, **kwargs)

            return call

        for name in ("fsync", "rename", "replace", "unlink", "mkdir"):
            setattr(os, name, counted(getattr(os, name)))


def kill_myself():
    os.kill(os.getpid(), signal.SIGKILL)


def _name_phases(where, hold):
    """Let the process tell what it is doing, and pause where ``hold`` begins: it may be over in a millisecond."""
    from ls3_recipes.experiment import Experiment
    from ls3_recipes.run_folder import RunFolder
    from ls3_torchrl.trainers import Checkpoints, Learner, VAETrainer

    def told(cls, method, name):
        function = getattr(cls, method)

        def call(self, *args, **kwargs):
            before = where.value
            where.value = (name or args[1]).encode()[:60]
            if where.value.decode() == hold:
                time.sleep(0.02)
            out = function(self, *args, **kwargs)
            if method == "save":
                where.value = before
            return out

        setattr(cls, method, call)

    for method, name in {
        "collect": "demonstrations",
        "resume": "taking up",
        "_collector": "planning",
        "_keep_episodes": "keeping episodes",
        "select": "selecting",
        "evaluate": "evaluation",
        "finish": "results",
    }.items():
        told(Experiment, method, name)
    told(RunFolder, "thin_out_agents", "planning")  # the last of an update
    told(VAETrainer, "_minimise", "VAE")
    told(VAETrainer, "encode", "encoding")
    told(Learner, "begin", None)
    told(Checkpoints, "save", "saving")


def _run(arguments, log, where, moment, hold):
    handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    torch.set_num_threads(1)
    from ls3_recipes.algorithms import ls3
    from ls3_recipes.commands.train import main

    ls3.probe = lambda *_: {}  # takes most of a tiny run's time, and changes nothing that is learnt
    _name_phases(where, hold)
    if moment is not None:
        moment.arm()
    where.value = b"start"
    main(arguments)
    if moment is not None:
        print(f"calls {moment.calls}")


class Run:
    """A run that is going on.

    Args:
        arguments: of ``ls3 train``.
        log: file that what it says is added to.
        moment: at which it ends itself.
        hold: phase at whose beginning it pauses.
    """

    def __init__(self, arguments, log, moment=None, hold=None):
        self.log = Path(log)
        self._where = CONTEXT.Array("c", 64)
        self.process = CONTEXT.Process(target=_run, args=(list(arguments), str(log), self._where, moment, hold))
        self.process.start()

    @property
    def phase(self):
        """What it is doing, or was when it ended."""
        return self._where.value.decode()

    def begun(self):
        """Wait until its work begins."""
        while not self.phase and self.process.is_alive():
            time.sleep(0.001)
        return self

    def send(self, number):
        """Send it a signal, unless it has ended."""
        if self.process.is_alive():
            os.kill(self.process.pid, number)

    def ended(self, timeout=120):
        """Wait for its end; its exit code, negative for a signal."""
        self.process.join(timeout)
        if self.process.is_alive():
            self.process.kill()
            raise TimeoutError(f"still at {self.phase!r} after {timeout} s:\n{self.said()}")
        return self.process.exitcode

    def said(self):
        """What it wrote to the terminal."""
        return self.log.read_text(encoding="utf-8", errors="replace")[-3000:]


def finished(folder, arguments):
    """Run, or go on with, a run to its end."""
    run = Run([*arguments, f"output={folder}"], f"{folder}.log")
    assert run.ended() == 0, run.said()
    return Path(folder)


def is_finished(folder):
    """Whether nothing is left to be done."""
    return (folder / "summary.json").is_file() and not any((folder / "checkpoints").glob("run-*"))


def _summary(folder):
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return {name: value for name, value in summary.items() if name not in CLOCK}


def _metrics(folder):
    """The rows of every phase in their order; those of phases side by side lie between each other as they came."""
    with (folder / "metrics.csv").open(newline="", encoding="utf-8") as file:
        rows = [[row[name] for name in ("phase", "step", "name", "value")] for row in csv.DictReader(file)]
    return sorted(rows, key=lambda row: row[0])


def _names(folder):
    skip = ("tensorboard", "lock")  # a lock says nothing once its process has ended
    return {
        str(path.relative_to(folder)) for path in folder.rglob("*") if path.relative_to(folder).parts[0] not in skip
    }


def _flat(content, where=()):
    if isinstance(content, list):
        content = dict(enumerate(content))
    if isinstance(content, dict):
        return {key: value for name, part in content.items() for key, value in _flat(part, (*where, name)).items()}
    return {where: content}


def _equal(one, other):
    one, other = _flat(one), _flat(other)
    return one.keys() == other.keys() and all(
        torch.equal(value, other[key]) if isinstance(value, torch.Tensor) else value == other[key]
        for key, value in one.items()
    )


def differences(one, other):
    """In what two finished runs differ: files, figures, metrics, weights and episodes, bit by bit."""
    found = []
    if _names(one) != _names(other):
        found.append(f"files: {_names(one) ^ _names(other)}")
    if _summary(one) != _summary(other):
        found.append("summary.json")
    if _metrics(one) != _metrics(other):
        found.append("metrics.csv")
    for path in sorted(one.rglob("*.pt")):
        parts = [torch.load(folder / path.relative_to(one), weights_only=True) for folder in (one, other)]
        if not _equal(*({"content": part} for part in parts)):
            found.append(str(path.relative_to(one)))
    for path in sorted(one.rglob("*.npy")):
        if path.read_bytes() != (other / path.relative_to(one)).read_bytes():
            found.append(str(path.relative_to(one)))
    return found
