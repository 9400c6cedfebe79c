"""A learner: what it starts from, descends and follows, and how divergence is reported."""

import pytest
import torch
from helpers import Silent
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.objectives import HardUpdate

from learning import AuxiliaryLoss, Learner, cooled_down
from ls3_torchrl import LS3Agent
from ls3_torchrl.modules import ValueEnsemble
from ls3_torchrl.objectives import EnsembleDynamicsLoss, OfflineValueLoss, SafeSetLoss, TD1ValueLoss


def test_td1_starts_from_what_reward_to_go_had_learnt():
    # With a target made beforehand, TD-1 pulled every value back towards that of an untrained network.
    value = ValueEnsemble(4, num_members=2, hidden=(16,))
    z = torch.randn(64, 4)
    reached = {"latent": z, "reward": torch.full((64, 1), -1.0)}
    batch = TensorDict({"latent": z, "reward_to_go": torch.full((64, 1), -100.0), "next": reached}, [64])
    first = Learner("value", OfflineValueLoss(value), lambda: batch, lr=0.03)
    second = Learner("value", TD1ValueLoss(value, gamma=0.99), lambda: batch, lr=0.03, target_interval=100)
    run = Silent()
    first.train(400, "Value, reward-to-go", run)
    before = value(batch.select("latent"))["state_value"].mean().item()
    assert before == pytest.approx(-100.0, abs=1.0)
    second.train(150, "Value, TD-1", run)
    # -1 + 0.99 * -100 = -100: the values that solve equation (3) solve equation (4) as well.
    assert value(batch.select("latent"))["state_value"].mean().item() == pytest.approx(-100.0, abs=2.0)


def test_several_losses_are_descended_together_and_the_target_moves_a_share_of_the_way():
    from ls3_torchrl.baselines import AWACLoss, action_value, gaussian_actor

    spec = Bounded(low=-1.0, high=1.0, shape=(1,))
    loss = AWACLoss(gaussian_actor(spec, 2, hidden=(4,)), action_value(spec, 2, hidden=(4,)))
    loss.make_value_estimator(gamma=0.9)
    over = {key: torch.ones(8, 1, dtype=torch.bool) for key in ("done", "terminated")}
    reached = {"loc": torch.randn(8, 2), "reward": torch.randn(8, 1), **over}
    batch = TensorDict({"loc": torch.randn(8, 2), "action": torch.zeros(8, 1), "next": reached}, [8])
    for names, moved in (("qvalue", [False, True]), (["actor", "qvalue"], [True, True])):
        params = (loss.actor_network_params, loss.qvalue_network_params)
        before = [p.clone().data for p in params]
        run = Silent()
        Learner(names, loss, batch.clone, lr=0.1, tau=0.25).train(1, "AWAC", run)
        # What is not descended is not reported as a loss.
        logged = {key for key in run.rows[0][2] if key.startswith("loss_")}
        assert logged == {f"loss_{name}" for name in ([names] if isinstance(names, str) else names)}
        assert [bool((a != b.data).any()) for a, b in zip(before, params, strict=True)] == moved
    learner = Learner("qvalue", loss, batch.clone, lr=0.1, tau=0.25)
    learner.train(1, "AWAC", Silent())  # its updater starts from a copy
    old = loss.qvalue_network_params.data.clone()
    lagging = loss.target_qvalue_network_params.data.clone()
    learner.train(1, "AWAC", Silent())
    new = loss.qvalue_network_params.data
    torch.testing.assert_close(loss.target_qvalue_network_params.data, 0.75 * lagging + 0.25 * new)
    assert bool((old != new).any())


def test_a_loss_that_is_not_finite_stops_the_phase_with_a_remedy():
    value = ValueEnsemble(4, num_members=2, hidden=(8,))
    bad = TensorDict({"latent": torch.randn(8, 4), "reward_to_go": torch.full((8, 1), torch.nan)}, [8])
    learner = Learner("value", OfflineValueLoss(value), lambda: bad, lr=1e-3)
    with pytest.raises(FloatingPointError, match="learning rate"):
        learner.train(3, "Value", Silent())


def test_a_term_beside_the_loss_pulls_the_same_network_with_its_weight():
    value = ValueEnsemble(4, num_members=1, hidden=(16,))
    z, far = torch.zeros(32, 4), torch.ones(32, 4)
    near_batch = TensorDict({"latent": z, "reward_to_go": torch.full((32, 1), -5.0)}, [32])
    far_batch = TensorDict({"latent": far, "reward_to_go": torch.full((32, 1), -60.0)}, [32])
    # On the same states, a term of weight 3 draws the least-squares value to three quarters of the way.
    both = AuxiliaryLoss(3.0, OfflineValueLoss(value), lambda: far_batch.set("latent", z))
    learner = Learner("value", OfflineValueLoss(value), lambda: near_batch, lr=0.05, auxiliary=both)
    run = Silent()
    learner.train(600, "Value", run)
    middle = (-5.0 + 3.0 * -60.0) / 4.0
    assert value(TensorDict({"latent": z[:1]}, [1]))["state_value"].item() == pytest.approx(middle, abs=0.5)
    assert "auxiliary" in run.rows[-1][2]


@pytest.mark.parametrize("name", ["dynamics", "value", "safe_set"])
def test_losses_and_gradients_under_bf16_agree_with_fp32(name):
    torch.manual_seed(0)
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


def test_the_learning_rate_falls_to_nothing_in_the_last_part_of_every_phase():
    assert [cooled_down(share, 0.5) for share in (0.0, 0.25, 0.5, 0.75, 0.9)] == pytest.approx([1, 1, 1, 0.5, 0.2])
    assert cooled_down(0.99, 0.0) == 1.0
    value = ValueEnsemble(4, num_members=2, hidden=(8,))
    rows = TensorDict({"latent": torch.randn(8, 4), "reward_to_go": torch.zeros(8, 1)}, [8])
    rates = []

    def sample():
        rates.append(learner.optimizer.param_groups[0]["lr"])
        return rows

    learner = Learner("value", OfflineValueLoss(value), sample, lr=0.4, cooldown=0.5)
    for _ in range(2):  # every phase starts warm again
        learner.train(4, "Value", Silent())
    assert rates == pytest.approx([0.4, 0.4, 0.4, 0.2] * 2)
