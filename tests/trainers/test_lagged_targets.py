"""Targets of a lagged network for many batches at once: what they are, and when they are computed."""

import copy
import math
from dataclasses import dataclass

import pytest
import torch
from tensordict import NestedKey, TensorDict
from tensordict.nn import TensorDictModule
from torchrl.objectives import HardUpdate

from ls3_torchrl.data import BatchStream, TaggedReplayBuffer
from ls3_torchrl.data import stream as stream_module
from ls3_torchrl.modules import SafeSet, ValueEnsemble
from ls3_torchrl.objectives import SafeSetLoss, TD1ValueLoss
from ls3_torchrl.trainers import Learner


class PerBatchValueLoss(TD1ValueLoss):
    """Nobody has promised that its targets are computed row by row."""


class PerBatchSafeSetLoss(SafeSetLoss):
    """Nobody has promised that its targets are computed row by row."""


def episode(seed: int, n: int = 50) -> TensorDict:
    torch.manual_seed(seed)
    step = {"reward": -torch.ones(n, 1), "pixels": torch.randn(n, 4)}
    step |= {k: torch.rand(n, 1) < 0.2 for k in ("constraint", "success")}
    return TensorDict({"pixels": torch.randn(n, 4), "action": torch.zeros(n, 2), "next": step}, [n])


@pytest.fixture
def buffer(monkeypatch) -> TaggedReplayBuffer:
    monkeypatch.setattr(stream_module, "_ROWS", 8 * 2 * 5)  # five batches of eight for two members
    buffer = TaggedReplayBuffer(capacity=300, latent_dim=4)
    buffer.add(episode(0), "success")
    buffer.encode(TensorDictModule(torch.nn.Identity(), ["pixels"], ["latent"]))
    return buffer


def learner_of(buffer, kind, interval=7, **options) -> Learner:
    torch.manual_seed(1)
    if issubclass(kind, TD1ValueLoss):
        loss, members = kind(ValueEnsemble(4, num_members=2, hidden=(16,)), bootstrap=True), 2
    else:
        loss, members = kind(SafeSet(4, hidden=(16,))), None
    batches = BatchStream(buffer, 8, reads=loss, extra_keys=["reward_to_go"], members=members)
    name = loss.out_keys[0].removeprefix("loss_")
    return Learner(name, loss, batches, lr=0.05, target_interval=interval, progress=False, **options)


def weights_of(learner) -> torch.Tensor:
    return torch.cat([parameter.detach().flatten() for parameter in learner.parameters])


def count_targets(learner) -> list[int]:
    """From now on, the rows of every call of the loss's ``targets``."""
    rows, targets = [], learner.loss.targets

    def counted(batch):
        rows.append(batch.numel())
        return targets(batch)

    learner.loss.targets = counted
    return rows


@pytest.mark.parametrize(
    ("ahead", "each"),
    [(TD1ValueLoss, PerBatchValueLoss), (SafeSetLoss, PerBatchSafeSetLoss)],
    ids=["value", "safe set"],
)
@pytest.mark.parametrize("interval", [1, 3, 5, 7, 100])
def test_training_is_what_it_is_with_targets_of_one_batch_at_a_time(buffer, ahead, each, interval):
    one, other = learner_of(buffer, ahead, interval), learner_of(buffer, each, interval)
    for steps, seed in ((23, 3), (9, 4)):  # a second phase begins between two copies
        one.train(steps, "TD-1", seed=seed)
        other.train(steps, "TD-1", seed=seed)
    torch.testing.assert_close(weights_of(one), weights_of(other), rtol=1e-5, atol=1e-6)


def test_targets_are_computed_once_for_all_batches_until_the_copy_or_the_last_one_drawn(buffer):
    learner = learner_of(buffer, TD1ValueLoss, interval=7)
    rows = count_targets(learner)
    learner.train(15, "TD-1", seed=3)
    # Drawn five at a time, copied after steps 7 and 14.
    assert rows == [size * 8 * 2 for size in (5, 2, 3, 4, 1)]
    each = learner_of(buffer, PerBatchValueLoss, interval=7)
    rows = count_targets(each)
    each.train(15, "TD-1", seed=3)
    assert rows == [8 * 2] * 15


@pytest.mark.parametrize("cut", range(1, 13))
def test_a_run_that_was_cut_anywhere_ends_with_the_same_bits(buffer, cut):
    uncut = learner_of(buffer, TD1ValueLoss, bf16=True)
    uncut.train(13, "TD-1", seed=3)

    class CutError(Exception):
        pass

    def after_step():
        if first.phase_steps == cut:
            raise CutError

    first = learner_of(buffer, TD1ValueLoss, bf16=True, after_step=after_step)
    with pytest.raises(CutError):
        first.train(13, "TD-1", seed=3)
    second = learner_of(buffer, TD1ValueLoss, bf16=True)
    second.load_state_dict(first.state_dict())
    second.train(13, "TD-1")
    assert torch.equal(weights_of(second), weights_of(uncut))


def test_a_network_with_a_hook_is_called_for_every_batch(buffer):
    learner = learner_of(buffer, TD1ValueLoss)
    seen = []
    learner.loss.value.network.register_forward_hook(lambda *_: seen.append(None))
    learner.train(6, "TD-1", seed=3)
    assert len(seen) == 2 * 6


def test_a_lagged_network_that_moves_at_every_step_is_asked_at_every_step(buffer):
    loss = TD1ValueLoss(ValueEnsemble(4, num_members=2, hidden=(16,)))
    learner = Learner("value", loss, BatchStream(buffer, 8, reads=loss), lr=0.05, tau=0.1, progress=False)
    rows = count_targets(learner)
    learner.train(6, "TD-1", seed=3)
    assert rows == [8] * 6


def test_the_batch_of_a_divergence_holds_what_it_was_compared_with(buffer):
    learner = learner_of(buffer, TD1ValueLoss)
    learner.train(1, "TD-1", seed=3)
    learner.begin(3, "TD-1", 4)
    batch = learner.new_batch()
    assert torch.equal(batch["lagged_value_target"], learner.loss.targets(batch.exclude("lagged_value_target")))


def test_a_value_is_compared_with_the_targets_that_a_batch_holds():
    value = ValueEnsemble(1, num_members=2, hidden=())
    for parameters, number in ((value.network.weights, 2.0), (value.network.biases, 0.0)):
        torch.nn.init.constant_(parameters[0], number)
    reached = {"latent": torch.tensor([[9.0]]), "reward": -torch.ones(1, 1)}
    held = torch.tensor([[[1.0], [4.0]]])
    batch = TensorDict({"latent": torch.tensor([[3.0]]), "lagged_value_target": held, "next": reached}, [1])
    loss = TD1ValueLoss(value)
    HardUpdate(loss, value_network_update_interval=99)
    # V(3) = 6 for both members.
    assert loss(batch)["loss_value"].item() == pytest.approx(((6 - 1) ** 2 + (6 - 4) ** 2) / 2)
    loss.set_keys(lagged_value_target="mine")
    assert loss(batch)["loss_value"].item() == pytest.approx((6 - (-1 + 0.99 * 18)) ** 2)


def test_a_safe_set_is_compared_with_the_targets_that_a_batch_holds():
    safe_set = SafeSet(1, hidden=())
    (layer,) = safe_set.network
    for parameter, number in ((layer.weight, 2.0), (layer.bias, 0.0)):
        torch.nn.init.constant_(parameter, number)
    no = torch.zeros(1, 1, dtype=torch.bool)
    batch = TensorDict({"latent": torch.tensor([[0.5]]), "in_success": no, "next": {"latent": torch.zeros(1, 1)}}, [1])
    batch["lagged_safe_set_target"] = torch.tensor([[0.75]])
    p = 1 / (1 + math.exp(-1.0))
    by_hand = -(0.75 * math.log(p) + 0.25 * math.log(1 - p))
    loss = SafeSetLoss(safe_set)
    HardUpdate(loss, value_network_update_interval=99)
    assert loss(batch)["loss_safe_set"].item() == pytest.approx(by_hand, rel=1e-5)


@pytest.mark.parametrize("shape", [(2,), (2, 3, 1), (3, 1)])
def test_targets_that_would_be_broadcast_are_refused(shape):
    value, no = ValueEnsemble(1, num_members=2, hidden=()), torch.zeros(2, 1, dtype=torch.bool)
    reached = {"latent": torch.zeros(2, 1), "reward": -torch.ones(2, 1)}
    batch = TensorDict({"latent": torch.zeros(2, 1), "in_success": no, "next": reached}, [])
    batch["lagged_value_target"] = batch["lagged_safe_set_target"] = torch.zeros(shape)
    for loss in (TD1ValueLoss(value), SafeSetLoss(SafeSet(1, hidden=()))):
        HardUpdate(loss, value_network_update_interval=99)
        with pytest.raises(ValueError, match=str(list(shape)).replace("[", r"\[")):
            loss(batch)


class ReversedStream(BatchStream):
    """Batches that are not those which were drawn."""

    def __call__(self):
        return super().__call__().flip(0)


class SmallerStream(BatchStream):
    """Batches that are parts of those which were drawn."""

    def __call__(self):
        return super().__call__()[:3]


@pytest.mark.parametrize("stream", [ReversedStream, SmallerStream])
def test_a_stream_of_ones_own_gets_no_targets_of_other_rows(buffer, stream):
    found = []
    for kind in (TD1ValueLoss, PerBatchValueLoss):
        learner = learner_of(buffer, kind)
        learner.sample = stream(buffer, 8, reads=learner.loss, extra_keys=["reward_to_go"], members=2)
        learner.train(9, "TD-1", seed=3)
        found.append(weights_of(learner))
    torch.testing.assert_close(*found, rtol=1e-5, atol=1e-6)


def normalise(learner):
    network = learner.loss.value.network
    learner.loss.value.network = Normalised(network)


class Normalised(torch.nn.Module):
    """A network in which rows of a batch have to do with each other."""

    def __init__(self, network):
        super().__init__()
        self.network = network
        self.weights, self.biases = network.weights, network.biases

    def forward(self, x, **options):
        out = self.network(x, **options)
        return out - out.mean(0)


@pytest.mark.parametrize(
    "change",
    [
        lambda learner: learner.sample(),
        lambda learner: setattr(learner.loss, "gamma", 0.5),
        lambda learner: setattr(learner.loss, "zero_at_goal", False),
        lambda learner: learner.loss.load_state_dict({k: 0.5 * v for k, v in learner.loss.state_dict().items()}),
        lambda learner: [weight.mul_(0.5) for weight in learner.loss.target_value_params.values(True, True)],
        lambda learner: learner.sample.buffer.add(episode(1), "success"),
        normalise,
    ],
    ids=["batch drawn", "gamma", "goal", "state", "lagged weights", "buffer", "network"],
)
@pytest.mark.parametrize("every", [2, 3, 5])
def test_what_changes_in_a_phase_changes_the_targets(buffer, change, every):
    found = []
    for kind in (TD1ValueLoss, PerBatchValueLoss):
        learner = learner_of(copy.deepcopy(buffer), kind)

        def after_step(learner=learner):
            if learner.steps % every == 0 and learner.steps < 2 * every:
                with torch.no_grad():
                    change(learner)

        learner.after_step = after_step
        learner.train(17, "TD-1", seed=3)
        found.append(weights_of(learner))
    torch.testing.assert_close(*found, rtol=1e-5, atol=1e-6)


def test_no_targets_are_computed_beyond_the_end_of_a_phase(buffer):
    learner = learner_of(buffer, TD1ValueLoss, interval=100)
    rows = count_targets(learner)
    learner.train(3, "TD-1", seed=3)
    learner.train(7, "TD-1", seed=4)
    assert rows == [size * 8 * 2 for size in (3, 5, 2)]


def test_a_hook_in_the_middle_of_a_phase_is_called_from_then_on(buffer):
    learner, seen = learner_of(buffer, TD1ValueLoss), []

    def after_step():
        if learner.steps == 2:
            learner.loss.value.network.register_forward_hook(lambda *_: seen.append(None))

    learner.after_step = after_step
    learner.train(6, "TD-1", seed=3)
    assert len(seen) == 2 * 4


def test_a_shorter_interval_of_a_state_from_the_middle_is_no_error(buffer):
    first = learner_of(buffer, TD1ValueLoss, interval=100)
    first.train(50, "TD-1", seed=3)
    second = learner_of(buffer, TD1ValueLoss, interval=10)
    second.load_state_dict(first.state_dict())
    second.train(5, "TD-1", seed=4)
    assert second.steps == 55


def test_a_subclass_with_keys_of_its_own_needs_none_for_targets(buffer):
    class OwnKeys(TD1ValueLoss):
        @dataclass
        class _AcceptedKeys:
            latent: NestedKey = "latent"
            next_latent: NestedKey = ("next", "latent")
            reward: NestedKey = ("next", "reward")
            reward_to_go: NestedKey = "reward_to_go"

    one, other = learner_of(buffer, OwnKeys), learner_of(buffer, TD1ValueLoss)
    for learner in (one, other):
        learner.train(9, "TD-1", seed=3)
    torch.testing.assert_close(weights_of(one), weights_of(other), rtol=1e-5, atol=1e-6)
