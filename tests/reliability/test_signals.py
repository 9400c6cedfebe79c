"""Ctrl-C and SIGTERM: the run saves, says how to continue, and leaves within seconds with the usual exit code."""

import random
import signal
import time

import pytest
from tiny_runs import ALWAYS, LS3, PHASES, Run, differences, finished, is_finished

LEAVES_WITHIN = 5.0
#: Saves by the clock never come: what is continued is what the signal had saved.
NEVER = "checkpoint_minutes=1e9"


@pytest.fixture(scope="module")
def uncut(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("uncut") / "run", [*LS3, NEVER])


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_saves_and_leaves(uncut, tmp_path, soak, number, code):
    chance, slowest = random.Random(int(number)), 0.0
    phases = [phase for phase in PHASES if phase != "saving"]
    for place, phase in enumerate(phases if soak else chance.sample(phases, 2)):
        folder = tmp_path / f"run{place}"
        run = Run([*LS3, NEVER, f"output={folder}"], tmp_path / "log", hold=phase).begun()
        while run.phase != phase and run.process.is_alive():
            time.sleep(0.0002)
        time.sleep(0.02 * chance.random())
        start = time.monotonic()
        run.send(number)
        left_with = run.ended()
        seconds = time.monotonic() - start
        slowest = max(slowest, seconds)
        print(f"{signal.Signals(number).name} in {run.phase}: left with {left_with} after {seconds:.2f} s")
        if left_with:
            assert left_with == code, run.said()
            assert f"resume={folder}" in run.said().replace("\n", "")
            assert not is_finished(folder)
            finished(folder, [*LS3, NEVER])
        assert differences(uncut, folder) == []
    assert slowest < LEAVES_WITHIN


def test_a_second_signal_ends_a_run_at_once(tmp_path):
    run = Run([*LS3, ALWAYS, "vae.steps=100000", "vae.batch_size=512", f"output={tmp_path / 'run'}"], tmp_path / "log")
    run.begun()
    while run.phase != "VAE":
        time.sleep(0.001)
    time.sleep(0.5)
    run.send(signal.SIGINT)
    time.sleep(0.01)
    run.send(signal.SIGINT)
    assert run.ended(10) in (-signal.SIGINT, 130)  # at once, or the step was over by then
