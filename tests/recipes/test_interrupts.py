"""Signals wait for what must not be cut, and a second one does not."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from ls3_recipes.interrupts import Interrupted, Interrupts


@pytest.mark.parametrize(
    ("number", "code", "said"), [(signal.SIGINT, 130, "stopped by Ctrl-C"), (signal.SIGTERM, 143, "stopped by SIGTERM")]
)
def test_a_signal_is_an_exception_with_the_shells_code(number, code, said):
    with pytest.raises(Interrupted, match=said) as raised, Interrupts():
        signal.raise_signal(number)
    assert raised.value.exit_code == code
    assert isinstance(raised.value, KeyboardInterrupt)  # nothing that catches errors catches it


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="the system has no such signal")
def test_the_end_of_a_connection_stops_a_run_but_not_one_under_nohup():
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run under nohup themselves
    try:
        with pytest.raises(Interrupted, match="stopped by SIGHUP") as raised, Interrupts():
            signal.raise_signal(signal.SIGHUP)
        assert raised.value.exit_code == 129
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        with Interrupts() as interrupts:
            signal.raise_signal(signal.SIGHUP)
            assert not interrupts.pending
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_signal_waits_for_the_end_of_what_must_not_be_cut():
    done = []

    def work():
        with Interrupts() as interrupts:
            with interrupts.deferred():
                with interrupts.deferred():
                    signal.raise_signal(signal.SIGTERM)
                    done.append("inner")
                assert interrupts.pending
                done.append("outer")
            done.append("behind")

    with pytest.raises(Interrupted):
        work()
    assert done == ["inner", "outer"]


def test_it_is_raised_earlier_where_the_work_can_be_cut():
    done = []

    def work():
        with Interrupts() as interrupts, interrupts.deferred():
            for step in range(9):
                if step == 2:
                    signal.raise_signal(signal.SIGINT)
                done.append(step)
                interrupts.check()

    with pytest.raises(Interrupted):
        work()
    assert done == [0, 1, 2]


def test_an_error_inside_is_not_hidden_by_a_signal_that_waits():
    def work():
        with Interrupts() as interrupts, interrupts.deferred():
            signal.raise_signal(signal.SIGINT)
            raise ValueError("real")

    with pytest.raises(ValueError, match="real"):
        work()


def test_signals_do_afterwards_what_they_did_before():
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    with Interrupts():
        assert signal.getsignal(signal.SIGTERM) != before[0]
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before


def test_in_another_thread_signals_are_left_alone():
    before, failed = signal.getsignal(signal.SIGTERM), []

    def listen():
        try:
            with Interrupts() as interrupts, interrupts.deferred():
                pass
        except Exception as error:  # to be looked at in the main thread
            failed.append(error)

    thread = threading.Thread(target=listen)
    thread.start()
    thread.join()
    assert not failed
    assert signal.getsignal(signal.SIGTERM) == before


SCRIPT = """
import time
from ls3_recipes.interrupts import Interrupts
with Interrupts() as interrupts, interrupts.deferred():
    print("ready", flush=True)
    time.sleep(60)
"""


def test_a_second_signal_ends_the_process_at_once():
    process = subprocess.Popen([sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    os.kill(process.pid, signal.SIGTERM)
    assert "once more" in process.stdout.readline()
    start = time.monotonic()
    os.kill(process.pid, signal.SIGTERM)
    assert process.wait(20) == -signal.SIGTERM
    assert time.monotonic() - start < 20
    process.stdout.close()
