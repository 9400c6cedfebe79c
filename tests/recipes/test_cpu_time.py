"""CPU time counts what processes do that nobody has waited for, and stays within what there is."""

import math
import subprocess
import sys
import time

import pytest

from ls3_recipes import cpu_time, progress
from ls3_recipes.cpu_time import cpu_seconds
from ls3_recipes.progress import Progress

linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells of living children")


WORK = """
import sys, time
while time.process_time() < 0.5:
    pass
print("done", flush=True)
sys.stdin.read()
"""


@linux
def test_children_that_live_and_those_that_ended_are_counted_once():
    before = cpu_seconds()
    command = [sys.executable, "-S", "-E", "-c", WORK]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout.readline() == "done\n"
        alive = cpu_seconds() - before
        child.stdin.close()
        child.wait()
    ended = cpu_seconds() - before
    assert alive >= 0.45
    # Waited for, it moves from the living to the ended, with the little that it did to end.
    assert alive - 0.02 <= ended <= alive + 0.4


def test_nothing_is_said_where_the_system_does_not_tell(monkeypatch, tmp_path):
    monkeypatch.setattr(cpu_time, "_PROC", tmp_path)
    assert math.isnan(cpu_seconds())
    one = Progress()
    with one.timed("vae"):
        pass
    assert list(one.spent()) == ["seconds"]


def test_utilisation_is_that_of_all_cores(monkeypatch):
    clock, busy = iter([10.0, 20.0, 20.0]), iter([1.0, 16.0])
    monkeypatch.setattr(progress, "available_cores", lambda: 2)
    monkeypatch.setattr(progress, "cpu_seconds", lambda: next(busy))
    monkeypatch.setattr(progress.time, "perf_counter", lambda: next(clock))
    one = Progress()
    with one.timed("vae"):
        pass
    assert one.spent() == {"seconds": {"vae": 10.0}, "cpu_utilisation": {"vae": 0.75}}


def test_a_state_of_before_leaves_out_the_phases_of_which_it_knows_nothing():
    one = Progress()
    with one.timed("vae"):
        pass
    state = one.state_dict()
    del state["cpu_seconds"]
    other = Progress()
    other.load_state_dict(state)
    with other.timed("vae"), other.timed("offline"):
        time.sleep(0.01)
    assert "vae" in other.spent()["seconds"]
    assert "vae" not in other.spent().get("cpu_utilisation", {})
