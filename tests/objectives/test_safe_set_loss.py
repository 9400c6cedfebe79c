"""Equation (5) restated by hand: max(1_S(z_t), γ_S f_S(z_{t+1})) by fixed-point iteration."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import HardUpdate

from ls3_torchrl.modules import SafeSet
from ls3_torchrl.objectives import SafeSetLoss


def linear_safe_set(slope: float) -> SafeSet:
    """A safe set whose logit is slope * z."""
    safe_set = SafeSet(1, hidden=())
    safe_set.network = nn.Linear(1, 1, bias=False)
    with torch.no_grad():
        safe_set.network.weight.fill_(slope)
    return safe_set


def lagged_loss(safe_set: SafeSet, **options: object) -> SafeSetLoss:
    """The loss with the updater that it asks for; its target copies the safe set as it is now."""
    loss = SafeSetLoss(safe_set, **options)
    HardUpdate(loss, value_network_update_interval=99)
    return loss


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def cross_entropy(probability: float, target: float) -> float:
    return -(target * math.log(probability) + (1 - target) * math.log(1 - probability))


def transitions(latent: list[float], next_latent: list[float], in_success: list[bool]) -> TensorDict:
    return TensorDict(
        {
            "latent": torch.tensor(latent).unsqueeze(-1),
            "in_success": torch.tensor(in_success).unsqueeze(-1),
            "next": {"latent": torch.tensor(next_latent).unsqueeze(-1)},
        },
        [len(latent)],
    )


def test_target_and_loss_by_hand():
    z, z_next, in_success = [0.3, -1.0, 2.0, 0.0], [1.0, 2.0, -3.0, 0.5], [True, False, False, True]
    loss = lagged_loss(linear_safe_set(2.0), gamma=0.3)
    targets = [max(float(s), 0.3 * sigmoid(2 * b)) for b, s in zip(z_next, in_success, strict=True)]
    batch = transitions(z, z_next, in_success)
    made = loss.target(batch["next", "latent"], batch["in_success"])
    assert made.shape == (4, 1)
    assert made.flatten().tolist() == pytest.approx(targets)
    assert targets[0] == targets[3] == 1.0
    by_hand = sum(cross_entropy(sigmoid(2 * a), y) for a, y in zip(z, targets, strict=True)) / 4
    assert loss(batch)["loss_safe_set"].item() == pytest.approx(by_hand, rel=1e-5)


def test_rows_count_by_their_weight_where_they_have_one():
    z, z_next, in_success = [0.3, -1.0, 2.0], [1.0, 2.0, -3.0], [True, False, False]
    loss = lagged_loss(linear_safe_set(2.0), gamma=0.3)
    batch = transitions(z, z_next, in_success)
    each = [
        cross_entropy(sigmoid(2 * a), max(float(s), 0.3 * sigmoid(2 * b)))
        for a, b, s in zip(z, z_next, in_success, strict=True)
    ]
    weight = torch.tensor([[1.0], [0.0], [0.25]])
    by_hand = (each[0] + 0.25 * each[2]) / 3
    assert loss(batch.clone().set("safe_set_weight", weight))["loss_safe_set"].item() == pytest.approx(by_hand)
    ones = batch.clone().set("safe_set_weight", torch.ones(3, 1))
    torch.testing.assert_close(loss(ones)["loss_safe_set"], loss(batch)["loss_safe_set"])
    loss.set_keys(weight=("mine", "weight"))
    assert loss(batch.clone().set(("mine", "weight"), weight))["loss_safe_set"].item() == pytest.approx(by_hand)


def test_float_labels_are_as_good_as_booleans():
    loss = lagged_loss(linear_safe_set(2.0))
    batch = transitions([0.3, -1.0], [1.0, 2.0], [True, False])
    as_bool = loss(batch)["loss_safe_set"]
    batch["in_success"] = batch["in_success"].float()
    assert torch.equal(loss(batch)["loss_safe_set"], as_bool)


def test_target_uses_the_lagged_weights_and_carries_no_gradient():
    safe_set = linear_safe_set(2.0)
    loss = lagged_loss(safe_set, gamma=0.5)
    with torch.no_grad():
        safe_set.network.weight.fill_(-1.0)
    out = loss(transitions([0.7], [1.5], [False]))["loss_safe_set"]
    # f_S(z) has the new slope -1, the target the old slope 2.
    target, probability = 0.5 * sigmoid(2.0 * 1.5), sigmoid(-1.0 * 0.7)
    assert out.item() == pytest.approx(cross_entropy(probability, target), rel=1e-5)
    # The slope of a cross-entropy in the logit is p - y, and the logit is w z.
    out.backward()
    assert safe_set.network.weight.grad.item() == pytest.approx((probability - target) * 0.7, rel=1e-5)
    assert not any(p.requires_grad for p in loss.target_safe_set_params.values(True, True))
    # So a second updater, for online training after offline, can be built on a loss that has been used.
    HardUpdate(loss, value_network_update_interval=99)


def test_without_discounted_successors_the_target_is_the_indicator():
    loss = lagged_loss(linear_safe_set(2.0), gamma=0.0)
    made = loss.target(torch.tensor([[5.0], [5.0]]), torch.tensor([[True], [False]]))
    assert made.flatten().tolist() == [1.0, 0.0]


def test_target_is_copied_at_updates_100_and_200_and_at_no_other():
    safe_set = linear_safe_set(0.0)
    loss = SafeSetLoss(safe_set)
    updater = HardUpdate(loss, value_network_update_interval=99)
    lagged = []
    for update in range(1, 251):
        with torch.no_grad():
            safe_set.network.weight.fill_(float(update))
        updater.step()
        lagged.append(loss.target_safe_set_params["network", "weight"].item())
    assert lagged == [0.0] * 99 + [100.0] * 100 + [200.0] * 51


def test_training_leaves_the_target_where_the_last_copy_put_it():
    safe_set = linear_safe_set(0.5)
    loss = SafeSetLoss(safe_set)
    updater = HardUpdate(loss, value_network_update_interval=2)
    optimiser = torch.optim.SGD(loss.parameters(), 0.5)
    batch = transitions([1.0, -2.0], [0.5, 1.0], [True, False])
    history = [0.5]
    for update in range(1, 8):
        loss(batch)["loss_safe_set"].backward()
        optimiser.step()
        optimiser.zero_grad()
        history.append(safe_set.network.weight.item())
        assert history[-1] != history[-2]
        updater.step()
        assert loss.target_safe_set_params["network", "weight"].item() == history[update // 3 * 3]


def test_fixed_point_iteration_spreads_safety_backwards_over_a_chain(minimise):
    # s0 -> s1 -> s2 -> s3, and only s3 lies on a successful trajectory: f_S(s_{3-k}) tends to γ^k.
    # A state u that leads to itself and to no success tends to 0, though it starts at one half.
    gamma, states = 0.5, torch.eye(5)
    safe_set = SafeSet(5, hidden=())
    safe_set.network = nn.Linear(5, 1, bias=False)
    nn.init.zeros_(safe_set.network.weight)
    batch = TensorDict(
        {
            "latent": states,
            "in_success": torch.tensor([[False], [False], [False], [True], [False]]),
            "next": {"latent": states[[1, 2, 3, 3, 4]]},
        },
        [5],
    )
    loss = SafeSetLoss(safe_set, gamma=gamma)
    updater = HardUpdate(loss, value_network_update_interval=59)
    minimise(loss, batch, "loss_safe_set", steps=600, lr=0.1, updater=updater)
    learnt = safe_set.probability(states).flatten()
    expected = torch.tensor([gamma**3, gamma**2, gamma, 1.0, 0.0])
    torch.testing.assert_close(learnt, expected, atol=0.03, rtol=0)


def test_nested_keys_of_loss_and_module():
    safe_set = SafeSet(3, hidden=(8,), latent_key=("m", "z"), logit_key=("m", "logit"))
    loss = lagged_loss(safe_set)
    z, z_next, label = torch.randn(5, 3), torch.randn(5, 3), torch.rand(5, 1) > 0.5
    flat = loss(TensorDict({"latent": z, "in_success": label, "next": {"latent": z_next}}, [5]))
    loss.set_keys(latent=("now", "z"), next_latent=("later", "z"), in_success=("labels", "safe"))
    nested = loss(TensorDict({"now": {"z": z}, "later": {"z": z_next}, "labels": {"safe": label}}, [5]))
    assert torch.equal(nested["loss_safe_set"], flat["loss_safe_set"])


def test_misspelt_and_missing_keys():
    loss = lagged_loss(linear_safe_set(1.0))
    with pytest.raises(ValueError, match="in_succes is not an accepted tensordict key"):
        loss.set_keys(in_succes="safe")
    batch = transitions([0.0], [1.0], [True])
    del batch["in_success"]
    with pytest.raises(KeyError, match=r"SafeSetLoss needs the keys \['in_success'\]"):
        loss(batch)


@pytest.mark.parametrize("gamma", [-0.1, 1.1, float("nan")])
def test_discounts_outside_the_unit_interval_are_refused(gamma: float):
    with pytest.raises(ValueError, match=r"gamma \(of the safe set\) must lie in \[0, 1\]"):
        SafeSetLoss(linear_safe_set(1.0), gamma=gamma)


def test_default_discount_is_table_1s_for_navigation():
    assert SafeSetLoss(linear_safe_set(1.0)).gamma == 0.3


def test_safe_set_overfits_eight_states(minimise):
    in_success = torch.tensor([True, False] * 4).unsqueeze(-1)
    batch = TensorDict(
        {"latent": torch.randn(8, 4), "in_success": in_success, "next": {"latent": torch.randn(8, 4)}}, [8]
    )
    safe_set = SafeSet(4, prob_key="safe_set_prob")
    # γ_S = 0 leaves plain labels, so that the loss can fall to zero.
    first, last = minimise(lagged_loss(safe_set, gamma=0.0), batch, "loss_safe_set", steps=80, lr=1e-3)
    assert last < 0.1 * first
    assert torch.equal(safe_set(batch)["safe_set_prob"] > 0.5, in_success)


def test_loss_names_its_keys():
    loss = lagged_loss(linear_safe_set(1.0))
    loss.set_keys(in_success="safe")
    assert loss.in_keys == ["latent", ("next", "latent"), "safe"]
    assert loss.out_keys == ["loss_safe_set"]
    assert "loss_safe_set" in repr(loss)


def test_loss_compiles_in_one_graph():
    loss = lagged_loss(SafeSet(4, hidden=(8,)))
    batch = TensorDict({"latent": torch.randn(6, 4), "in_success": torch.tensor([[True], [False]] * 3)}, [6])
    batch["next"] = {"latent": torch.randn(6, 4)}
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(batch)["loss_safe_set"], loss(batch)["loss_safe_set"])


def test_any_module_whose_first_output_is_a_logit_is_a_safe_set():
    foreign = TensorDictModule(nn.Linear(1, 1, bias=False), [("m", "z")], [("m", "score")])
    nn.init.constant_(foreign.module.weight, 2.0)
    batch = transitions([0.3, -1.0], [1.0, 2.0], [True, False])
    ours, theirs = lagged_loss(foreign), lagged_loss(linear_safe_set(2.0))
    assert torch.equal(ours(batch)["loss_safe_set"], theirs(batch)["loss_safe_set"])
    before = ours.target(batch["next", "latent"], batch["in_success"])
    ours(batch)["loss_safe_set"].backward()
    assert foreign.module.weight.grad.abs().sum() > 0
    with torch.no_grad():
        foreign.module.weight.fill_(-1.0)
    assert torch.equal(ours.target(batch["next", "latent"], batch["in_success"]), before)


def test_a_safe_sets_own_forward_is_not_bypassed():
    class Certain(SafeSet):
        def forward(self, tensordict: TensorDict) -> TensorDict:
            tensordict = super().forward(tensordict)
            return tensordict.set("safe_set_logit", 0.0 * tensordict["safe_set_logit"] + 3.0)

    loss = lagged_loss(Certain(1, hidden=()), gamma=0.5)
    out = loss(transitions([0.3], [1.0], [False]))
    assert out["loss_safe_set"].item() == pytest.approx(cross_entropy(sigmoid(3.0), 0.5 * sigmoid(3.0)), rel=1e-5)
