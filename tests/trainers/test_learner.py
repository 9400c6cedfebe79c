"""A learner: what it starts from, minimises and follows, how divergence is reported, and how it continues."""

import copy
import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.objectives import HardUpdate
from torchrl.record.loggers import CSVLogger

from ls3_torchrl import LS3Agent
from ls3_torchrl.baselines import AWACLoss, action_value, gaussian_actor
from ls3_torchrl.modules import ValueEnsemble
from ls3_torchrl.objectives import EnsembleDynamicsLoss, OfflineValueLoss, SafeSetLoss, TD1ValueLoss
from ls3_torchrl.trainers import DivergenceError, Learner, LearnerGroup
from ls3_torchrl.trainers.steps import threads


def values(value, latent):
    return value(TensorDict({"latent": latent}, [len(latent)]))["state_value"]


def test_td1_starts_from_what_reward_to_go_had_learnt():
    # With a target made beforehand, TD-1 pulled every value back towards that of an untrained network.
    value = ValueEnsemble(4, num_members=2, hidden=(16,))
    z = torch.randn(64, 4)
    reached = {"latent": z, "reward": torch.full((64, 1), -1.0)}
    batch = TensorDict({"latent": z, "reward_to_go": torch.full((64, 1), -100.0), "next": reached}, [64])
    first = Learner("value", OfflineValueLoss(value), lambda: batch, lr=0.03, progress=False)
    second = Learner(
        "value", TD1ValueLoss(value, gamma=0.99), lambda: batch, lr=0.03, target_interval=100, progress=False
    )
    first.train(400, "Value, reward-to-go")
    assert values(value, z).mean().item() == pytest.approx(-100.0, abs=1.0)
    second.train(150, "Value, TD-1")
    # -1 + 0.99 * -100 = -100: the values that solve equation (3) solve equation (4) as well.
    assert values(value, z).mean().item() == pytest.approx(-100.0, abs=2.0)


def awac():
    spec = Bounded(low=-1.0, high=1.0, shape=(1,))
    loss = AWACLoss(gaussian_actor(spec, 2, hidden=(4,)), action_value(spec, 2, hidden=(4,)))
    loss.make_value_estimator(gamma=0.9)
    over = {key: torch.ones(8, 1, dtype=torch.bool) for key in ("done", "terminated")}
    reached = {"loc": torch.randn(8, 2), "reward": torch.randn(8, 1), **over}
    return loss, TensorDict({"loc": torch.randn(8, 2), "action": torch.zeros(8, 1), "next": reached}, [8])


@pytest.mark.parametrize(("names", "moved"), [("qvalue", [False, True]), (["actor", "qvalue"], [True, True])])
def test_the_losses_that_are_named_are_minimised_together_and_logged_alone(recorder, names, moved):
    loss, batch = awac()
    params = (loss.actor_network_params, loss.qvalue_network_params)
    before = [p.clone().data for p in params]
    Learner(names, loss, batch.clone, lr=0.1, tau=0.25, logger=recorder, progress=False).train(1, "AWAC")
    logged = {name.removeprefix("AWAC/") for name, _, _ in recorder.rows if name.startswith("AWAC/loss_")}
    assert logged == {f"loss_{name}" for name in ([names] if isinstance(names, str) else names)}
    assert [bool((a != b.data).any()) for a, b in zip(before, params, strict=True)] == moved


def test_with_tau_the_target_moves_a_fraction_of_the_way_at_every_step():
    loss, batch = awac()
    learner = Learner("qvalue", loss, batch.clone, lr=0.1, tau=0.25, progress=False)
    learner.train(1, "AWAC")  # its updater starts from a copy
    old = loss.qvalue_network_params.data.clone()
    lagging = loss.target_qvalue_network_params.data.clone()
    learner.train(1, "AWAC")
    new = loss.qvalue_network_params.data
    torch.testing.assert_close(loss.target_qvalue_network_params.data, 0.75 * lagging + 0.25 * new)
    assert bool((old != new).any())


def test_a_loss_that_is_not_finite_stops_the_phase_with_a_remedy():
    value = ValueEnsemble(4, num_members=2, hidden=(8,))
    bad = TensorDict({"latent": torch.randn(8, 4), "reward_to_go": torch.full((8, 1), torch.nan)}, [8])
    learner = Learner("value", OfflineValueLoss(value), lambda: bad, lr=1e-3, progress=False)
    with pytest.raises(FloatingPointError, match=r"Value diverged.*learning rate"):
        learner.train(3, "Value")


@pytest.mark.parametrize("name", ["dynamics", "value", "safe_set"])
def test_losses_and_gradients_under_bf16_agree_with_fp32(name):
    agent = LS3Agent(action_dim=2, latent_dim=8)
    rows = TensorDict(
        {
            "latent": torch.randn(256, 5, 8),
            "action": torch.randn(256, 5, 2),
            "reward_to_go": -60.0 - 5.0 * torch.rand(256, 5, 1),
            "in_success": torch.rand(256, 5, 1) < 0.5,
            "next": {"latent": torch.randn(256, 5, 8)},
        },
        [256, 5],
    )
    losses = {
        "dynamics": (EnsembleDynamicsLoss(agent.dynamics, bootstrap=True), rows),
        "value": (OfflineValueLoss(agent.value, bootstrap=True), rows),
        "safe_set": (SafeSetLoss(agent.safe_set, gamma=0.3), rows[:, 0]),
    }
    loss, batch = losses[name]
    if name == "safe_set":
        HardUpdate(loss, value_network_update_interval=99)
    found = []
    for bf16 in (False, True):
        learner = Learner(name, loss, lambda: batch, lr=1e-3, bf16=bf16)
        learner.optimizer.zero_grad()
        _, value = learner.compute_loss()
        value.backward()
        assert all(p.grad.dtype == torch.float32 for p in learner.parameters)
        found.append((value.detach(), torch.cat([p.grad.flatten() for p in learner.parameters])))
    (exact, gradient), (rough, rounded) = found
    torch.testing.assert_close(rough, exact, rtol=5e-3, atol=0.0)
    assert not torch.equal(rounded, gradient)
    assert (rounded - gradient).norm() < 0.05 * gradient.norm()  # bf16 rounds by 0.4 % at every product


def td1_learner(seed):
    torch.manual_seed(seed)
    value = ValueEnsemble(4, num_members=2, hidden=(8,))
    generator = torch.Generator().manual_seed(7)

    def sample():
        z = torch.randn(16, 4, generator=generator)
        reached = {"latent": z + 0.1, "reward": -torch.rand(16, 1, generator=generator)}
        return TensorDict({"latent": z, "next": reached}, [16])

    learner = Learner("value", TD1ValueLoss(value), sample, lr=0.01, target_interval=5, progress=False)
    return learner, generator


def test_a_learner_that_continues_from_its_state_ends_as_one_that_was_never_stopped():
    whole, _ = td1_learner(0)
    whole.train(12, "Value")
    first, generator = td1_learner(0)
    first.train(8, "Value")  # between two copies to the target, with Adam's moments warm
    second, later = td1_learner(1)
    later.set_state(generator.get_state())
    second.load_state_dict(first.state_dict())
    second.train(4, "Value")
    assert second.steps == whole.steps == 12
    assert second.target.counter == whole.target.counter
    for name, expected in whole.loss.state_dict().items():
        assert torch.equal(second.loss.state_dict()[name], expected), name


def test_a_state_keeps_whether_there_was_a_target_yet():
    fresh, _ = td1_learner(0)
    other, _ = td1_learner(1)
    other.load_state_dict(fresh.state_dict())
    assert other.target is None


def test_progress_bars_can_be_switched_off(capsys):
    learner, _ = td1_learner(0)
    learner.train(2, "Value")
    assert capsys.readouterr().err == ""
    learner.progress = True
    learner.train(2, "Value")
    assert "Value" in capsys.readouterr().err


def test_any_logger_of_torchrl_serves(tmp_path):
    learner, _ = td1_learner(0)
    learner.logger = CSVLogger("run", log_dir=str(tmp_path))
    learner.train(3, "Value")
    lines = (tmp_path / "run" / "scalars" / "Value" / "loss_value.csv").read_text().splitlines()
    assert [int(line.split(",")[0]) for line in lines] == [1, 3]


def test_threads_are_put_back_even_when_the_work_fails():
    before = torch.get_num_threads()
    inside = []

    def fail():
        with threads(before + 1):
            inside.append(torch.get_num_threads())
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert inside == [before + 1]
    assert torch.get_num_threads() == before


def test_a_state_is_continued_at_the_learning_rate_of_the_learner_that_reads_it():
    first, _ = td1_learner(0)
    first.train(3, "Value")
    second, _ = td1_learner(0)
    second.lr = 1e-5
    second.load_state_dict(first.state_dict())
    assert [group["lr"] for group in second.optimizer.param_groups] == [1e-5]


@pytest.mark.parametrize("stop", [1, 4, 9, 12])
def test_a_phase_that_was_stopped_at_any_step_is_taken_up_there(recorder, stop):
    whole, _ = td1_learner(0)
    whole.logger = recorder
    whole.train(12, "Value")
    first, generator = td1_learner(0)
    kept = {}

    def keep():
        if first.steps == stop:
            kept.update(state=first.state_dict(), draws=generator.get_state())
            raise KeyboardInterrupt

    first.after_step = keep
    with pytest.raises(KeyboardInterrupt):
        first.train(12, "Value")
    second, later = td1_learner(1)
    second.logger = type(recorder)()
    later.set_state(kept["draws"])
    second.load_state_dict(kept["state"])
    second.train(12, "Value")
    assert second.steps == 12
    assert second.logger.rows == [row for row in recorder.rows if row[2] > stop]
    for name, expected in whole.loss.state_dict().items():
        assert torch.equal(second.loss.state_dict()[name], expected), name
    second.train(3, "Value")  # the next phase starts at its beginning
    assert second.steps == 15


class _Poison(torch.autograd.Function):
    """A loss that is finite, and a gradient that is not."""

    @staticmethod
    def forward(ctx, x):
        return x

    @staticmethod
    def backward(ctx, grad):
        return grad * float("nan")


@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_divergence_stops_at_its_very_step_and_leaves_finite_weights_and_its_batch(where, monkeypatch):
    learner, _ = td1_learner(0)
    clean, calls = learner.compute_loss, []

    def poisoned():
        losses, value = clean()
        calls.append(len(calls))
        if len(calls) < 8:
            return losses, value
        return losses, value * float("nan") if where == "loss" else _Poison.apply(value)

    monkeypatch.setattr(learner, "compute_loss", poisoned)
    with pytest.raises(DivergenceError, match=r"Value diverged.*at step 7.*learning rate") as caught:
        learner.train(20, "Value")
    assert learner.steps == caught.value.step == 7
    assert all(torch.isfinite(p).all() for p in learner.parameters)
    assert caught.value.batch["latent"].shape == (16, 4)
    assert all(torch.isfinite(m).all() for s in learner.optimizer.state.values() for m in s.values())


def group_of_two(seed, after_step=None):
    (one, draws), (two, more) = td1_learner(seed), td1_learner(seed + 10)
    one.after_step = two.after_step = after_step
    return LearnerGroup({"one": one, "two": two}), (draws, more)


@pytest.mark.parametrize("stop", range(1, 13))
def test_a_group_continues_with_the_learner_that_was_stopped(stop):
    stages = [("one", 4, "One"), ("two", 5, "Two"), ("one", 3, "One again")]
    whole, _ = group_of_two(0)
    whole.train(stages)
    calls, kept = [], {}

    def keep():
        calls.append(None)
        if len(calls) == stop:
            kept.update(state=first.state_dict(), draws=[generator.get_state() for generator in generators])
            raise KeyboardInterrupt

    first, generators = group_of_two(0, keep)
    with pytest.raises(KeyboardInterrupt):
        first.train(stages)
    second, later = group_of_two(3)
    for generator, state in zip(later, kept["draws"], strict=True):
        generator.set_state(state)
    second.load_state_dict(kept["state"])
    second.train(stages)
    for name, learner in whole.learners.items():
        assert second.learners[name].steps == learner.steps
        for key, expected in learner.loss.state_dict().items():
            assert torch.equal(second.learners[name].loss.state_dict()[key], expected), (name, key)


def test_a_state_from_the_middle_of_a_list_goes_on_with_no_other_list():
    stages = [("one", 3, "One"), ("two", 4, "Two")]
    taken = []
    first, _ = group_of_two(0)
    first.learners["two"].after_step = lambda: taken.append(copy.deepcopy(first.state_dict()))
    first.train(stages)
    second, _ = group_of_two(1)
    second.load_state_dict(taken[1])
    with pytest.raises(RuntimeError, match=r"middle of other training, .* with 1 of 2 done; .*Call first what was"):
        second.train([("one", 3, "One")])
    second.train(stages)
    assert (second.learners["one"].steps, second.learners["two"].steps) == (3, 4)
    second.train([("one", 3, "One")])  # that list is done
    assert second.learners["one"].steps == 6


@pytest.mark.parametrize("size", [1e20, 1e30])
def test_a_gradient_whose_square_overflows_stops_as_well(size):
    # Adam's average of squares would be infinite for ever, and nothing would move or be said any more.
    learner, _ = td1_learner(0)
    weight = learner.parameters[0]
    before = weight.detach().clone()
    weight.register_hook(lambda gradient: torch.full_like(gradient, size))
    with pytest.raises(DivergenceError, match="at step 0, and its gradient is not finite") as caught:
        learner.train(3, "Value")
    assert torch.equal(weight, before)
    assert all(map(math.isfinite, caught.value.scalars.values()))


def test_a_phase_that_was_ended_goes_on_and_no_other_begins_in_its_place():
    learner, _ = td1_learner(0)

    def stop():
        if learner.steps == 2:
            learner.after_step = None
            raise InterruptedError

    learner.after_step = stop
    with pytest.raises(InterruptedError):
        learner.train(10, "Value")
    with pytest.raises(RuntimeError, match=r"2 steps of \(10, 'Value'\) were taken; now \(7, 'Other'\)"):
        learner.train(7, "Other")
    learner.train(10, "Value")
    assert learner.steps == 10
    learner.train(7, "Other")
    assert learner.steps == 17


def test_an_error_of_divergence_crosses_processes():
    error = DivergenceError("Value", 7, {"loss_value": float("nan")}, None, "Lower its learning rate.")
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.phase, again.step) == (str(error), "Value", 7)
