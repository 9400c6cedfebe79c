"""Equations (3) and (4) restated by hand on small chains."""

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import HardUpdate

from ls3_torchrl.modules import ValueEnsemble
from ls3_torchrl.objectives import OfflineValueLoss, TD1ValueLoss


def linear_value(*slopes: float) -> ValueEnsemble:
    """Member m values the latent z at slopes[m] * z."""
    value = ValueEnsemble(1, num_members=len(slopes), hidden=())
    with torch.no_grad():
        value.network.weights[0].copy_(torch.tensor(slopes).view(-1, 1, 1))
        value.network.biases[0].zero_()
    return value


def td1_loss(value: ValueEnsemble, **options: object) -> TD1ValueLoss:
    """The loss with the updater that it asks for; its target copies the value as it is now."""
    loss = TD1ValueLoss(value, **options)
    HardUpdate(loss, value_network_update_interval=99)
    return loss


def tabular_value(values: list[float]) -> ValueEnsemble:
    """One member that looks a one-hot latent up in a table."""
    value = ValueEnsemble(len(values), num_members=1, hidden=())
    with torch.no_grad():
        value.network.weights[0].copy_(torch.tensor(values).view(1, -1, 1))
        value.network.biases[0].zero_()
    return value


def column(values: list) -> torch.Tensor:
    return torch.tensor(values).unsqueeze(-1)


def steps(latent: list, next_latent: list, reward: list) -> TensorDict:
    z, z_next, r = column(latent), column(next_latent), column(reward)
    return TensorDict({"latent": z, "next": {"latent": z_next, "reward": r}}, z.shape[:-1])


# Equation (3)


def test_offline_loss_is_the_squared_distance_to_the_reward_to_go():
    slopes, z, returns = (1.0, -2.0), [0.5, 3.0, -1.0], [-2.0, -1.5, 0.0]
    batch = TensorDict({"latent": column(z), "reward_to_go": column(returns)}, [3])
    out = OfflineValueLoss(linear_value(*slopes))(batch)
    cells = [(s * a - g) ** 2 for s in slopes for a, g in zip(z, returns, strict=True)]
    assert out["loss_value"].item() == pytest.approx(sum(cells) / 6)


def test_offline_bootstrap_column_m_teaches_member_m():
    slopes = (1.0, -2.0)
    z, returns = [[0.5, 1.0], [3.0, -1.0]], [[-2.0, -1.0], [0.0, -3.0]]
    batch = TensorDict({"latent": column(z), "reward_to_go": column(returns)}, [2, 2])
    value = linear_value(*slopes)
    out = OfflineValueLoss(value, bootstrap=True)(batch)
    cells = [(slopes[m] * z[i][m] - returns[i][m]) ** 2 for i in range(2) for m in range(2)]
    assert out["loss_value"].item() == pytest.approx(sum(cells) / 4)
    # d/ds of the average over four cells, member by member.
    out["loss_value"].backward()
    slopes_by_hand = [sum(2 * (slopes[m] * z[i][m] - returns[i][m]) * z[i][m] for i in range(2)) / 4 for m in range(2)]
    assert value.network.weights[0].grad.flatten().tolist() == pytest.approx(slopes_by_hand)


def test_exact_values_of_equation_3_solve_equation_4_too():
    # Rewards of the steps from s0, s1, s2 are -1; s3 lies in the goal and stays there for a reward of 0.
    gamma, rewards = 0.9, [-1.0, -1.0, -1.0, 0.0]
    values = [sum(gamma**i * r for i, r in enumerate(rewards[t:])) for t in range(4)]
    states = torch.eye(4)
    reached = states[[1, 2, 3, 3]]
    td1 = TensorDict({"latent": states, "next": {"latent": reached, "reward": column(rewards)}}, [4])
    offline = TensorDict({"latent": states, "reward_to_go": column(values)}, [4])
    value = tabular_value(values)
    assert OfflineValueLoss(value)(offline)["loss_value"].item() == pytest.approx(0.0, abs=1e-10)
    assert td1_loss(value, gamma=gamma)(td1)["loss_value"].item() == pytest.approx(0.0, abs=1e-10)
    assert values[0] == pytest.approx(-1 - 0.9 - 0.81)


# Equation (4)


def test_td1_loss_by_hand_every_member_bootstraps_from_itself():
    slopes, z, z_next = (1.0, -2.0), [0.5, 3.0], [1.5, 2.0]
    loss = td1_loss(linear_value(*slopes), gamma=0.5)
    targets = [[-1 + 0.5 * s * b for s in slopes] for b in z_next]
    made = loss.target(column(z_next), column([-1.0, -1.0]))
    assert made.shape == (2, 2, 1)
    assert made[..., 0].tolist() == targets
    cells = [(slopes[m] * z[i] - targets[i][m]) ** 2 for i in range(2) for m in range(2)]
    out = loss(steps(z, z_next, [-1.0, -1.0]))
    assert out["loss_value"].item() == pytest.approx(sum(cells) / 4)


def test_td1_bootstrap_column_m_teaches_member_m():
    slopes = (1.0, -2.0)
    z, z_next = [[0.5, 1.0], [3.0, -1.0]], [[1.5, 2.0], [0.0, 4.0]]
    rewards = [[-1.0, 0.0], [-1.0, -1.0]]
    cells = []
    for i in range(2):
        for m in range(2):
            target = 0.0 if rewards[i][m] == 0 else rewards[i][m] + 0.5 * slopes[m] * z_next[i][m]
            cells.append((slopes[m] * z[i][m] - target) ** 2)
    loss = td1_loss(linear_value(*slopes), gamma=0.5, bootstrap=True)
    assert loss(steps(z, z_next, rewards))["loss_value"].item() == pytest.approx(sum(cells) / 4)


def test_target_uses_the_lagged_weights():
    value = linear_value(2.0)
    loss = td1_loss(value, gamma=0.5)
    with torch.no_grad():
        value.network.weights[0].fill_(7.0)
    # V(z) has the new slope 7, the target still the old slope 2.
    out = loss(steps([1.0], [3.0], [-1.0]))
    assert out["loss_value"].item() == pytest.approx((7.0 * 1.0 - (-1 + 0.5 * 2.0 * 3.0)) ** 2)


def test_target_carries_no_gradient():
    value = linear_value(2.0)
    loss = td1_loss(value, gamma=0.5)
    loss(steps([2.0], [3.0], [-1.0]))["loss_value"].backward()
    # V(z_t) alone is differentiated: 2 (w z - target) z with w z = 4 and target = -1 + 0.5·2·3 = 2.
    assert value.network.weights[0].grad.item() == pytest.approx(2 * (4.0 - 2.0) * 2.0)
    assert not any(p.requires_grad for p in loss.target_value_params.values(True, True))
    # So a second updater, for online training after offline, can be built on a loss that has been used.
    HardUpdate(loss, value_network_update_interval=99)


@pytest.mark.parametrize(("zero_at_goal", "target"), [(True, 0.0), (False, 0.0 + 0.5 * 2.0 * 3.0)])
def test_the_target_in_the_goal_is_zero_or_the_bootstrap(zero_at_goal: bool, target: float):
    loss = td1_loss(linear_value(2.0), gamma=0.5, zero_at_goal=zero_at_goal)
    made = loss.target(column([3.0, 3.0]), column([0.0, -1.0]))
    assert made.flatten().tolist() == [target, -1 + 0.5 * 2.0 * 3.0]


def test_the_end_of_an_episode_does_not_mask_the_bootstrap():
    loss = td1_loss(linear_value(2.0), gamma=0.5)
    batch = steps([1.0, 4.0], [3.0, 5.0], [-1.0, -1.0])
    ended = torch.ones(2, 1, dtype=torch.bool)
    batch["next"].update({"done": ended, "terminated": ended, "truncated": ended})
    by_hand = ((2.0 - (-1 + 3.0)) ** 2 + (8.0 - (-1 + 5.0)) ** 2) / 2
    assert loss(batch)["loss_value"].item() == pytest.approx(by_hand)


def test_target_is_copied_at_updates_100_and_200_and_at_no_other():
    value = linear_value(0.0)
    loss = TD1ValueLoss(value)
    updater = HardUpdate(loss, value_network_update_interval=99)
    lagged = []
    for update in range(1, 251):
        with torch.no_grad():
            value.network.weights[0].fill_(float(update))
        updater.step()
        lagged.append(loss.target_value_params["network", "weights", "0"].item())
    assert lagged == [0.0] * 99 + [100.0] * 100 + [200.0] * 51


def test_training_leaves_the_target_where_the_last_copy_put_it():
    torch.manual_seed(1)
    value = ValueEnsemble(2, num_members=2, hidden=(8,))
    loss = TD1ValueLoss(value, gamma=0.5)
    updater = HardUpdate(loss, value_network_update_interval=2)
    optimiser = torch.optim.Adam(loss.parameters(), 0.05)
    batch = TensorDict({"latent": torch.randn(6, 2)}, [6])
    batch["next"] = {"latent": torch.randn(6, 2), "reward": -torch.ones(6, 1)}
    history = [value.network.weights[0].detach().clone()]
    for update in range(1, 8):
        loss(batch)["loss_value"].backward()
        optimiser.step()
        optimiser.zero_grad()
        history.append(value.network.weights[0].detach().clone())
        assert not torch.equal(history[-1], history[-2])
        updater.step()
        lagged = loss.target_value_params["network", "weights", "0"]
        assert torch.equal(lagged, history[update // 3 * 3])


def test_default_discount_is_table_1s():
    loss = td1_loss(linear_value(1.0))
    assert (loss.gamma, loss.zero_at_goal) == (0.99, True)


# Keys, options and learning


def test_nested_keys_of_losses_and_module():
    value = ValueEnsemble(3, hidden=(8,), latent_key=("m", "z"), value_key=("m", "v"))
    offline, td1 = OfflineValueLoss(value), td1_loss(value)
    z, z_next, g = torch.randn(5, 3), torch.randn(5, 3), torch.randn(5, 1)
    flat = TensorDict({"latent": z, "reward_to_go": g, "next": {"latent": z_next, "reward": g}}, [5])
    nested = TensorDict({"now": {"z": z, "g": g}, "later": {"z": z_next}}, [5])
    plain = [offline(flat)["loss_value"], td1(flat)["loss_value"]]
    offline.set_keys(latent=("now", "z"), reward_to_go=("now", "g"))
    td1.set_keys(latent=("now", "z"), next_latent=("later", "z"), reward=("now", "g"))
    assert torch.equal(offline(nested)["loss_value"], plain[0])
    assert torch.equal(td1(nested)["loss_value"], plain[1])


@pytest.mark.parametrize("make", [OfflineValueLoss, td1_loss])
def test_misspelt_and_missing_keys(make: Callable):
    loss = make(linear_value(1.0))
    with pytest.raises(ValueError, match="rewards is not an accepted tensordict key"):
        loss.set_keys(rewards="r")
    missing = "reward_to_go" if make is OfflineValueLoss else r"\('next', 'reward'\)"
    batch = TensorDict({"latent": torch.zeros(2, 1), "next": {"latent": torch.zeros(2, 1)}}, [2])
    with pytest.raises(KeyError, match=rf"{type(loss).__name__} needs the keys .*{missing}"):
        loss(batch)


@pytest.mark.parametrize("make", [OfflineValueLoss, td1_loss])
def test_a_bootstrap_batch_needs_one_column_per_member(make: Callable):
    loss = make(linear_value(1.0, 2.0), bootstrap=True)
    batch = steps([1.0, 2.0], [1.0, 2.0], [-1.0, -1.0])
    batch["reward_to_go"] = batch["next", "reward"]
    with pytest.raises(ValueError, match=r"latents of shape \[B, 2, D\]"):
        loss(batch)


@pytest.mark.parametrize("gamma", [-0.1, 1.1, float("nan")])
def test_discounts_outside_the_unit_interval_are_refused(gamma: float):
    with pytest.raises(ValueError, match=r"gamma must lie in \[0, 1\]"):
        TD1ValueLoss(linear_value(1.0), gamma=gamma)


def test_values_overfit_eight_returns(minimise):
    batch = TensorDict({"latent": torch.randn(8, 4), "reward_to_go": -5 * torch.rand(8, 1)}, [8])
    value = ValueEnsemble(4)
    first, last = minimise(OfflineValueLoss(value), batch, "loss_value", steps=80, lr=1e-3)
    assert last < 0.01 * first
    # The loss trained the module that it was given, not a copy.
    predicted = value(batch.clone())["state_value"]
    torch.testing.assert_close(predicted.mean(1), batch["reward_to_go"], atol=0.5, rtol=0)


def test_td1_finds_the_values_of_a_chain(minimise):
    # s0 -> s1 -> s2 -> goal: values -(1 + γ + γ²), -(1 + γ), -1 and 0.
    states = torch.eye(4)
    transition = {"latent": states[[1, 2, 3, 3]], "reward": column([-1.0, -1.0, -1.0, 0.0])}
    batch = TensorDict({"latent": states, "next": transition}, [4])
    value = tabular_value([0.0, 0.0, 0.0, 0.0])
    loss = TD1ValueLoss(value, gamma=0.5)
    updater = HardUpdate(loss, value_network_update_interval=59)
    minimise(loss, batch, "loss_value", steps=300, lr=5e-2, updater=updater)
    learnt = value(TensorDict({"latent": states}, [4]))["state_value"].flatten()
    torch.testing.assert_close(learnt, torch.tensor([-1.75, -1.5, -1.0, 0.0]), atol=0.03, rtol=0)


def test_losses_name_their_keys():
    offline, td1 = OfflineValueLoss(linear_value(1.0)), td1_loss(linear_value(1.0))
    td1.set_keys(reward="r")
    assert offline.in_keys == ["latent", "reward_to_go"]
    assert td1.in_keys == ["latent", ("next", "latent"), "r"]
    assert offline.out_keys == td1.out_keys == ["loss_value"]
    assert "loss_value" in repr(td1)


def test_td1_loss_compiles_in_one_graph():
    loss = td1_loss(ValueEnsemble(4, hidden=(8,)))
    batch = TensorDict({"latent": torch.randn(6, 4)}, [6])
    batch["next"] = {"latent": torch.randn(6, 4), "reward": column([-1.0, 0.0] * 3)}
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(batch)["loss_value"], loss(batch)["loss_value"])


# Values of other makes


def single_value(slope: float) -> TensorDictModule:
    """One value, without members, under keys of its own."""
    value = TensorDictModule(nn.Linear(1, 1, bias=False), [("model", "z")], [("model", "v")])
    nn.init.constant_(value.module.weight, slope)
    return value


def test_a_single_value_learns_as_an_ensemble_of_one():
    batch = steps([0.5, 3.0], [1.5, 2.0], [-1.0, 0.0]).set("reward_to_go", column([-2.0, -1.5]))
    single, ensemble = single_value(2.0), linear_value(2.0)
    for make, options in ((OfflineValueLoss, {}), (td1_loss, {"gamma": 0.5})):
        ours, theirs = make(single, **options)(batch), make(ensemble, **options)(batch)
        torch.testing.assert_close(ours["loss_value"], theirs["loss_value"])
        ours["loss_value"].backward()
        theirs["loss_value"].backward()
        torch.testing.assert_close(single.module.weight.grad, ensemble.network.weights[0].grad[0])


def test_a_single_values_target_lags_and_has_its_own_shape():
    value = single_value(2.0)
    loss = td1_loss(value, gamma=0.5)
    with torch.no_grad():
        value.module.weight.fill_(7.0)
    assert loss.target(column([3.0]), column([-1.0])).tolist() == [[-1 + 0.5 * 2.0 * 3.0]]


@pytest.mark.parametrize("make", [OfflineValueLoss, td1_loss])
def test_bootstrap_batches_need_an_ensemble(make: Callable):
    with pytest.raises(TypeError, match=r"bootstrap=True\) needs an ensemble.*TensorDictModule is none"):
        make(single_value(1.0), bootstrap=True)


@pytest.mark.parametrize("make", [OfflineValueLoss, td1_loss])
def test_values_without_a_last_dimension_are_refused(make: Callable):
    # Against targets [B, 1] they would broadcast to [B, B].
    flat = TensorDictModule(nn.Sequential(nn.Linear(1, 1), nn.Flatten(0)), ["latent"], ["v"])
    batch = steps([0.5, 3.0], [1.5, 2.0], [-1.0, 0.0]).set("reward_to_go", column([-2.0, -1.5]))
    with pytest.raises(ValueError, match=r"targets of shape \[2, 1\] with predictions of shape \[2\]"):
        make(flat)(batch)


def test_a_values_own_forward_is_not_bypassed():
    class Shifted(ValueEnsemble):
        def forward(self, tensordict: TensorDict, *, per_member: bool = False) -> TensorDict:
            tensordict = super().forward(tensordict, per_member=per_member)
            return tensordict.set("state_value", 10.0 + 0.0 * tensordict["state_value"])

    batch = steps([0.5], [1.5], [-1.0]).set("reward_to_go", column([-2.0]))
    assert OfflineValueLoss(Shifted(1, hidden=()))(batch)["loss_value"].item() == pytest.approx(12.0**2)
    td1 = td1_loss(Shifted(1, hidden=()), gamma=0.5)
    assert td1(batch)["loss_value"].item() == pytest.approx((10.0 - (-1 + 5.0)) ** 2)
