"""Kills and signals while learners are trained in processes of their own: none is left behind, and nothing is lost."""

import os
import random
import signal
import sys
import time
from pathlib import Path

import pytest
from tiny_runs import ALWAYS, LS3, Run, differences, finished, is_finished

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")

#: Steps that are worth a process each.
MANY = [f"offline.{name}_steps=800" for name in ("dynamics", "value", "classifier")]
TWO = [*(setting for setting in LS3 if not setting.startswith("threads")), "threads=2", *MANY]
NEVER = "checkpoint_minutes=1e9"


@pytest.fixture(scope="module")
def uncut(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("uncut") / "run", [*TWO, NEVER])


def processes_of(run):
    """Those that a run has forked."""
    try:
        return Path(f"/proc/{run.process.pid}/task/{run.process.pid}/children").read_text().split()
    except FileNotFoundError:
        return []


def is_alive(number):
    try:
        return "zombie" not in Path(f"/proc/{number}/status").read_text()
    except FileNotFoundError:
        return False


def while_side_by_side(folder, chance, *settings):
    """A run that is learning in three processes, and these."""
    run = Run([*TWO, *settings, f"output={folder}"], f"{folder}.log").begun()
    while len(forked := processes_of(run)) < 3 and run.process.is_alive():
        time.sleep(0.001)
    time.sleep(chance.random())
    return run, forked


def all_have_ended(forked):
    for _ in range(100):
        if not any(is_alive(number) for number in forked):
            return True
        time.sleep(0.1)
    return False


@pytest.mark.parametrize("seed", range(2))
def test_a_killed_run_takes_its_processes_along_and_goes_on_to_the_same_bits(uncut, tmp_path, seed):
    run, forked = while_side_by_side(tmp_path / "run", random.Random(seed), ALWAYS)
    assert len(forked) == 3
    run.process.kill()
    run.ended()
    assert all_have_ended(forked)
    assert differences(uncut, finished(tmp_path / "run", [*TWO, ALWAYS])) == []


def test_a_run_whose_process_is_killed_ends_in_the_same_bits(uncut, tmp_path):
    run, forked = while_side_by_side(tmp_path / "run", random.Random(0), NEVER)
    os.kill(int(forked[0]), signal.SIGKILL)
    assert run.ended() == 0, run.said()
    assert "results stay the same" in run.said().replace("\n", " ")
    assert differences(uncut, tmp_path / "run") == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_all_processes_saves_and_leaves(uncut, tmp_path, number):
    run, forked = while_side_by_side(tmp_path / "run", random.Random(int(number)), NEVER)
    for each in forked:
        os.kill(int(each), number)
    run.send(number)
    assert run.ended() == 128 + number, run.said()
    assert all_have_ended(forked)
    assert not is_finished(tmp_path / "run")
    assert differences(uncut, finished(tmp_path / "run", [*TWO, NEVER])) == []
