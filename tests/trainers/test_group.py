"""Learners side by side in processes: the results, metrics, states and errors of one after another."""

import copy
import math
import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule

from ls3_torchrl.data import BatchStream, TaggedReplayBuffer
from ls3_torchrl.modules import GoalEstimator
from ls3_torchrl.objectives import ClassifierLoss
from ls3_torchrl.trainers import (
    DivergenceError,
    Learner,
    LearnerGroup,
    LS3Options,
    LS3Trainer,
    OfflineOptions,
    OnlineOptions,
    OptimOptions,
)
from ls3_torchrl.trainers import group as group_module
from ls3_torchrl.trainers.together import can_train_together

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    """Two threads, and processes for the least work, which tell their states all the time."""
    before = torch.get_num_threads()
    monkeypatch.setattr(group_module, "_WORTH_A_PROCESS", 1)
    monkeypatch.setattr(group_module, "_INTERVAL", 0.0)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def forks(monkeypatch):
    """The numbers of processes that were forked."""
    counts, plain = [], group_module.Processes

    def counted(target, tasks, nice):
        counts.append(len(tasks))
        return plain(target, tasks, nice)

    monkeypatch.setattr(group_module, "Processes", counted)
    return counts


@pytest.fixture
def make_trainer(make_agent, episode):
    def make(threads, seed=0, steps=30, **how):
        torch.set_num_threads(1)  # on which latents depend by their last bits
        torch.manual_seed(seed)
        agent, buffer = make_agent(), TaggedReplayBuffer(100, latent_dim=8)
        for tag, rises in {"success": {"success": 8}, "constraint": {"constraint": 5}}.items():
            buffer.add(episode(actions=torch.randn(9, 2), **rises), tag)
        buffer.encode(agent.encoder)
        options = LS3Options(OfflineOptions(steps, steps, steps), OnlineOptions(steps, steps, steps), OptimOptions(16))
        torch.set_num_threads(threads)
        return LS3Trainer(agent, buffer, options, progress=False, **how)

    return make


def tensors(state, path=""):
    """The leaves of a state, by path."""
    if isinstance(state, dict):
        return {k: v for name, part in state.items() for k, v in tensors(part, f"{path}/{name}").items()}
    if isinstance(state, list | tuple):
        return {k: v for i, part in enumerate(state) for k, v in tensors(part, f"{path}/{i}").items()}
    return {path: state}


def assert_same(state, expected):
    one, other = tensors(state), tensors(expected)
    assert one.keys() == other.keys()
    for path, value in one.items():
        same = torch.equal(value, other[path]) if isinstance(value, torch.Tensor) else value == other[path]
        assert same, path


def test_results_and_metrics_do_not_depend_on_the_number_of_cores(make_trainer, recorder, forks):
    alone = make_trainer(1, logger=recorder)
    aside = make_trainer(2, logger=(metrics := type(recorder)()))
    for trainer, threads in ((alone, 1), (aside, 2)):
        torch.set_num_threads(threads)
        torch.manual_seed(7)
        trainer.train_offline()
        trainer.update()
    assert forks == [3, 3]
    assert_same(aside.state_dict(), alone.state_dict())
    assert_same(dict(aside.agent.state_dict()), dict(alone.agent.state_dict()))
    assert sorted(metrics.rows) == sorted(recorder.rows)
    assert aside.goal.logger is metrics


def test_a_state_from_the_middle_goes_on_with_one_core_or_two(make_trainer, forks):
    whole = make_trainer(1, steps=120)
    kept = []
    first = make_trainer(2, steps=120, after_step=lambda: kept.append(copy.deepcopy(first.state_dict())))
    for trainer in (whole, first):
        torch.manual_seed(7)
        trainer.train_offline()
    middle = [state for state in kept if any(state[name]["phase_steps"] for name in first.learners)]
    assert middle, "no state was taken in the middle"
    for threads in (1, 2):
        second = make_trainer(threads, seed=1, steps=120)
        second.buffer.load_state_dict(first.buffer.state_dict())
        second.load_state_dict(copy.deepcopy(middle[len(middle) // 2]))
        second.train_offline()
        for name, learner in whole.learners.items():
            assert second.learners[name].steps == learner.steps
            assert_same(second.learners[name].loss.state_dict(), learner.loss.state_dict())


def test_what_after_step_raises_ends_the_training_and_its_processes(make_trainer, forks):
    def stop():
        raise InterruptedError

    trainer = make_trainer(2, steps=100_000, after_step=stop)
    with pytest.raises(InterruptedError):
        trainer.train_offline()
    assert forks == [3]
    assert 0 < sum(learner.steps for learner in trainer.learners.values()) < 100_000
    assert not multiprocessing.active_children()


def test_divergence_in_a_process_is_raised_with_its_step_and_leaves_finite_weights(make_trainer):
    trainer = make_trainer(2)
    weight = trainer.dynamics.parameters[0]
    weight.register_hook(lambda gradient: gradient * (math.nan if trainer.dynamics.steps == 7 else 1.0))
    with pytest.raises(DivergenceError, match=r"Dynamics diverged.*at step 7.*learning rate") as caught:
        trainer.train_offline()
    assert trainer.dynamics.steps == caught.value.step == 7
    assert torch.isfinite(weight).all()


def test_what_a_process_that_died_was_training_is_trained_all_the_same(make_trainer):
    alone, aside = make_trainer(1), make_trainer(2)
    here, weight = os.getpid(), aside.dynamics.parameters[0]

    def die(gradient):
        if os.getpid() != here and aside.dynamics.steps == 7:
            os.kill(os.getpid(), signal.SIGKILL)
        return gradient

    weight.register_hook(die)
    torch.set_num_threads(1)
    torch.manual_seed(7)
    alone.train_offline()
    torch.set_num_threads(2)
    torch.manual_seed(7)
    with pytest.warns(RuntimeWarning, match="results stay the same"):
        aside.train_offline()
    assert_same(aside.state_dict(), alone.state_dict())


def test_where_autograd_forbids_forks_learners_are_trained_here(make_trainer, monkeypatch, forks):
    alone, aside = make_trainer(1), make_trainer(2)
    here, plain = os.getpid(), torch.Tensor.backward

    def backward(tensor):
        if os.getpid() != here:
            raise RuntimeError("Unable to handle autograd's threading in combination with fork-based multiprocessing.")
        plain(tensor)

    monkeypatch.setattr(torch.Tensor, "backward", backward)
    for trainer, threads in ((alone, 1), (aside, 2)):
        torch.set_num_threads(threads)
        torch.manual_seed(7)
        trainer.train_offline()
    assert forks == [3]
    assert_same(aside.state_dict(), alone.state_dict())


class Dropping(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layers = torch.nn.Sequential(torch.nn.Linear(8, 8), torch.nn.Dropout(0.5), torch.nn.Linear(8, 1))

    def forward(self, latent):
        return self.layers(latent)


def test_a_learner_whose_random_numbers_are_pytorchs_own_is_trained_here(make_agent, episode, forks):
    agent = make_agent(value=TensorDictModule(Dropping(), ["latent"], ["state_value"]))
    buffer = TaggedReplayBuffer(100, latent_dim=8)
    buffer.add(episode(success=8, constraint=4), "success")
    buffer.encode(agent.encoder)
    trainer = LS3Trainer(agent, buffer, LS3Options(OfflineOptions(3, 3, 3), optim=OptimOptions(16)), progress=False)
    assert not trainer.value.is_independent
    assert trainer.dynamics.is_independent
    torch.set_num_threads(2)
    trainer.train_offline()
    assert forks == [2]
    assert trainer.value.steps == trainer.dynamics.steps == 3


def classifiers(buffer, sizes=(16, 16), kind=Learner, sources=None, heads=None):
    heads = heads or [GoalEstimator(8, hidden=(8,)) for _ in sizes]
    losses = [ClassifierLoss(head) for head in heads]
    streams = sources or [BatchStream(buffer, size, reads=loss) for size, loss in zip(sizes, losses, strict=True)]
    return [kind("goal", *given, lr=1e-2, progress=False) for given in zip(losses, streams, strict=True)]


@pytest.fixture
def buffer(make_agent, episode):
    filled = TaggedReplayBuffer(100, latent_dim=8)
    filled.add(episode(success=8), "success")
    filled.encode(make_agent().encoder)
    return filled


class Own(Learner):
    def compute_loss(self):
        return super().compute_loss()


def test_learners_take_their_steps_together_where_nothing_forbids_it(buffer):
    assert can_train_together(classifiers(buffer))
    assert not can_train_together(classifiers(buffer, sizes=(16, 8)))
    assert not can_train_together(classifiers(buffer, kind=Own))
    assert not can_train_together(classifiers(buffer, heads=[GoalEstimator(8)] * 2))
    assert not can_train_together(classifiers(buffer, sources=[lambda: buffer.sample(16)] * 2))
    hooked = classifiers(buffer)
    hooked[0].loss.classifier.network[0].register_forward_hook(lambda *_: None)
    assert not can_train_together(hooked)


def test_a_name_that_does_not_exist_leaves_the_group_as_it_was(buffer):
    group = LearnerGroup({"goal": classifiers(buffer)[0]})
    with pytest.raises(KeyError, match="gaol"):
        group.train([("gaol", 3, "Goal")])
    group.train([("goal", 3, "Goal")])
    assert group.learners["goal"].steps == 3


def test_a_daemon_trains_by_itself(make_trainer):
    def train():
        trainer = make_trainer(2)
        trainer.train_offline()
        connection.send(trainer.dynamics.steps)

    context = multiprocessing.get_context("fork")
    listener, connection = context.Pipe(duplex=False)
    daemon = context.Process(target=train, daemon=True)
    daemon.start()
    assert listener.poll(60)
    assert listener.recv() == 30
    daemon.join()


def test_a_process_that_has_done_its_work_ends_with_the_one_that_forked_it(buffer):
    def train():
        torch.set_num_threads(2)
        first, second = classifiers(buffer)
        connection.send(os.getpid())
        LearnerGroup({"a": first, "b": second}).train([("a", 1, "A"), ("b", 1_000_000, "B")])

    context = multiprocessing.get_context("fork")
    listener, connection = context.Pipe(duplex=False)
    parent = context.Process(target=train)
    parent.start()
    children = Path(f"/proc/{listener.recv()}/task/{parent.pid}/children")
    while len(forked := children.read_text().split()) < 2:
        time.sleep(0.01)
    time.sleep(1.0)
    parent.kill()
    parent.join()
    for number in forked:
        status = Path(f"/proc/{number}/status")
        for _ in range(100):
            if not status.exists() or "zombie" in status.read_text():
                break
            time.sleep(0.1)
        assert not status.exists() or "zombie" in status.read_text()
