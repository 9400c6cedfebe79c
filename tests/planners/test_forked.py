"""Plans imagined in several processes: the same as in one, and no process that nobody needs."""

import copy
import gc
import multiprocessing
import os
import pickle
import signal
import sys
import time

import pytest
import torch
from torchrl.data import Bounded

from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator, SafeSet, ValueEnsemble
from ls3_torchrl.planners import FusedImagination, ImaginationNoise, LatentEnv, Limits
from ls3_torchrl.planners import fused as fused_module

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")

D, A, M, P, B, N, H = 4, 2, 3, 4, 3, 50, 3


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    """Two threads, processes from the second call on, and none at the end."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    monkeypatch.setattr(fused_module, "_CALLS_BEFORE_FORK", 1)
    monkeypatch.setattr(fused_module, "_SMALLEST_PART", 50)
    yield
    torch.set_num_threads(before)


def make():
    torch.manual_seed(0)
    env = LatentEnv(
        EnsembleDynamics(D, A, num_members=M, hidden=(8,)),
        ConstraintEstimator(D, hidden=(8,)),
        GoalEstimator(D, hidden=(8,)),
        action_spec=Bounded(low=-1.0, high=1.0, shape=(A,)),
    )
    return FusedImagination(
        env, ValueEnsemble(D, num_members=2, hidden=(8,)), SafeSet(D, hidden=(8,)), precision="fp32"
    )


@pytest.fixture
def imagine():
    made = make()
    yield made
    made._end_helpers()


def work(seed=0):
    generator = torch.Generator().manual_seed(seed)
    members = torch.randint(M, (H, P), generator=generator)
    noise = torch.randn(B, H, P, D, generator=generator)
    latent, actions = torch.randn(B, D, generator=generator), torch.rand(B, N, H, A, generator=generator)
    return (
        latent,
        actions,
        ImaginationNoise(members, noise),
        Limits(torch.full((B, 1), 0.353), 0.9),
    )  # some are feasible


def assert_same(one, other):
    for mine, its in zip(one, other, strict=True):
        assert torch.equal(mine.nan_to_num(-7.0), its.nan_to_num(-7.0))


def test_processes_imagine_what_threads_do(imagine):
    alone = [imagine(*work(seed)) for seed in range(3)][2:]
    assert multiprocessing.active_children()
    del imagine._helpers
    imagine._helpers, imagine._calls = None, -sys.maxsize
    assert_same(alone[0], imagine(*work(2)))
    assert 0.0 < alone[0].value.isnan().float().mean() < 1.0
    assert not multiprocessing.active_children()


def test_changed_weights_are_seen(imagine):
    first = [imagine(*work()) for _ in range(3)][-1]
    with torch.no_grad():
        imagine.value.network.weights[0].mul_(2.0)
    again = imagine(*work())
    assert not multiprocessing.active_children()  # these had the weights of before
    assert not torch.equal(first.value.nan_to_num(), again.value.nan_to_num())
    assert_same(again, [imagine(*work()) for _ in range(2)][-1])
    assert multiprocessing.active_children()


def test_the_work_of_a_process_that_died_is_done_all_the_same(imagine):
    expected = [imagine(*work()) for _ in range(2)][-1]
    (child,) = multiprocessing.active_children()
    os.kill(child.pid, signal.SIGKILL)
    child.join()
    with pytest.warns(RuntimeWarning, match="plans stay the same"):
        assert_same(imagine(*work()), expected)
    for _ in range(3):
        assert_same(imagine(*work()), expected)  # in threads, and without another warning
    assert not multiprocessing.active_children()


def test_what_is_raised_ends_the_processes_and_comes_through(imagine, monkeypatch):
    here, plain = os.getpid(), FusedImagination._imagine

    def fails(self, latent, *others):
        if os.getpid() != here and latent[0, 0] > 100.0:
            raise FloatingPointError("in the process")
        if os.getpid() == here and latent[0, 0] < -100.0:
            raise KeyboardInterrupt
        return plain(self, latent, *others)

    monkeypatch.setattr(FusedImagination, "_imagine", fails)
    latent, *others = work()
    for offset, error in ((200.0, FloatingPointError), (-200.0, KeyboardInterrupt)):
        expected = [imagine(latent, *others) for _ in range(3)][-1]
        assert multiprocessing.active_children()
        with pytest.raises(error):
            imagine(latent + offset, *others)
        assert not multiprocessing.active_children()
        assert_same(imagine(latent, *others), expected)


def test_copies_have_processes_of_their_own(imagine):
    expected = [imagine(*work()) for _ in range(2)][-1]
    copies = [copy.deepcopy(imagine), pickle.loads(pickle.dumps(imagine))]
    assert len(multiprocessing.active_children()) == 1
    for other in copies:
        for _ in range(2):
            assert_same(other(*work()), expected)
    assert len(multiprocessing.active_children()) == 3
    del copies, other
    gc.collect()
    assert len(multiprocessing.active_children()) == 1


def test_processes_end_with_what_they_work_for():
    imagine = make()
    for _ in range(2):
        imagine(*work())
    assert multiprocessing.active_children()
    del imagine
    gc.collect()
    assert not multiprocessing.active_children()


def test_another_number_of_threads(imagine):
    expected = [imagine(*work()) for _ in range(2)][-1]
    torch.set_num_threads(3)
    torch.testing.assert_close(imagine(*work()).value, expected.value, equal_nan=True)
    assert not multiprocessing.active_children()  # the next call makes two
    imagine(*work())
    assert len(multiprocessing.active_children()) == 2
    torch.set_num_threads(1)
    imagine(*work())


def test_a_process_that_is_left_alone_ends(imagine):
    def leave():
        for _ in range(2):
            imagine(*work())
        (child,) = multiprocessing.active_children()
        connection.send(child.pid)
        os.kill(os.getpid(), signal.SIGKILL)

    context = multiprocessing.get_context("fork")
    listener, connection = context.Pipe(duplex=False)
    parent = context.Process(target=leave)
    parent.start()
    child = listener.recv()
    parent.join()
    for _ in range(100):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    with open(f"/proc/{child}/status") as status:
        assert "zombie" in status.read()  # ended, and nobody has asked how


def test_a_daemon_has_threads_instead(imagine):
    def plan():
        for _ in range(3):
            imagine(*work())
        connection.send(len(multiprocessing.active_children()))

    context = multiprocessing.get_context("fork")
    listener, connection = context.Pipe(duplex=False)
    daemon = context.Process(target=plan, daemon=True)
    daemon.start()
    assert listener.recv() == 0
    daemon.join()


def test_a_fork_leaves_the_processes_of_its_parent_alone(imagine):
    expected = [imagine(*work()) for _ in range(2)][-1]

    def plan():
        for _ in range(20):
            found = imagine(*work(1))
        connection.send(found.safe_set_prob.numpy())

    context = multiprocessing.get_context("fork")
    listener, connection = context.Pipe(duplex=False)
    other = context.Process(target=plan)
    other.start()
    for _ in range(20):
        assert_same(imagine(*work()), expected)
    theirs = listener.recv()
    other.join()
    assert torch.equal(imagine(*work(1)).safe_set_prob, torch.from_numpy(theirs))


def test_another_reduction_is_seen(imagine):
    first = [imagine(*work()) for _ in range(3)][-1]
    imagine.safe_set_reduction = "min"
    changed = [imagine(*work()) for _ in range(3)]
    assert (changed[0].safe_set_prob < first.safe_set_prob).all()
    assert_same(changed[0], changed[2])
