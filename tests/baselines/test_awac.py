"""AWAC's actor loss restated by hand, and what it learns on a bandit."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import SoftUpdate

from ls3_torchrl.baselines import AWACLoss, action_value, gaussian_actor

SPEC = Bounded(low=-2.0, high=2.0, shape=(1,))


def make(**options) -> AWACLoss:
    loss = AWACLoss(
        gaussian_actor(SPEC, 3, hidden=(16,), initial_std=0.3), action_value(SPEC, 3, hidden=(16,)), **options
    )
    loss.make_value_estimator(gamma=options.pop("gamma", 0.9))
    SoftUpdate(loss, tau=0.05)
    return loss


def batch(count: int = 32) -> TensorDict:
    over = {key: torch.zeros(count, 1, dtype=torch.bool) for key in ("done", "terminated")}
    reached = {"loc": torch.randn(count, 3), "reward": -torch.rand(count, 1), **over}
    action = 4 * torch.rand(count, 1) - 2
    return TensorDict({"loc": torch.randn(count, 3), "action": action, "next": reached}, [count])


def test_actor_loss_by_hand():
    loss, rows = make(temperature=0.05), batch()
    advantage = torch.randn(32)
    loss.advantage = lambda td: advantage
    weights = torch.exp(advantage / 0.05 - (advantage / 0.05).max()).double()
    weights = weights / weights.mean()
    log_prob = loss.actor_network.get_dist(rows).log_prob(rows["action"].clamp(-1.96, 1.96))  # margin of 1 % of 4
    by_hand = -(weights * log_prob.double()).mean()
    assert loss(rows)["loss_actor"].item() == pytest.approx(by_hand.item(), rel=1e-4)


def test_advantage_is_the_least_value_of_the_data_above_that_of_the_actor():
    loss, rows = make(), batch()
    values = []
    for params in loss.qvalue_network_params.unbind(0):
        with params.to_module(loss.qvalue_network):
            values.append(loss.qvalue_network(rows.copy())["state_action_value"].squeeze(-1))
    least = torch.stack(values).amin(0)
    torch.manual_seed(1)
    advantage = loss.advantage(rows)
    assert not advantage.requires_grad
    torch.manual_seed(1)
    own = loss.actor_network.get_dist(rows).rsample()
    theirs = []
    for params in loss.qvalue_network_params.unbind(0):
        with params.to_module(loss.qvalue_network):
            theirs.append(loss.qvalue_network(rows.copy().set("action", own))["state_action_value"].squeeze(-1))
    torch.testing.assert_close(advantage, least - torch.stack(theirs).amin(0))


@pytest.mark.parametrize("temperature", [1e-3, 1.0, 1e6])
def test_weights_have_mean_one_and_are_finite_whatever_the_rewards_scale(temperature):
    weights = make(temperature=temperature).weights(torch.linspace(-1000.0, 1000.0, 50))
    assert torch.isfinite(weights).all()
    assert weights.mean().item() == pytest.approx(1.0, rel=1e-5)
    if temperature == 1e6:  # plain behaviour cloning
        torch.testing.assert_close(weights, torch.ones(50), atol=2e-3, rtol=0)
    else:
        assert weights.argmax() == 49


def test_entropy_is_worth_nothing():
    losses = make()(batch())
    assert losses["alpha"] < 1e-20
    assert not losses["loss_alpha"].requires_grad


def test_actions_on_the_edge_count_as_those_just_inside():
    loss, rows = make(margin=0.01), batch(8)
    rows["action"] = torch.full((8, 1), 2.0)
    loss.advantage = lambda td: torch.zeros(8)
    on_the_edge = loss(rows)["loss_actor"]
    rows["action"] = torch.full((8, 1), 1.96)
    torch.testing.assert_close(loss(rows)["loss_actor"], on_the_edge)
    assert torch.isfinite(on_the_edge)


def test_it_learns_the_better_of_two_actions_where_cloning_learns_both():
    # Reward 1 for +1, 0 for -1, and that is all: a bandit with as many bad as good demonstrations.
    rows = batch(64)
    rows["loc"] = torch.zeros(64, 3)
    rows["action"] = torch.where(torch.arange(64)[:, None] % 2 == 0, 1.0, -1.0)
    rows["next", "reward"] = (rows["action"] > 0).float()
    rows["next", "terminated"] = rows["next", "done"] = torch.ones(64, 1, dtype=torch.bool)
    means = {}
    for temperature in (0.1, 1e6):
        torch.manual_seed(0)
        loss = make(temperature=temperature)
        optimiser = torch.optim.Adam([p for p in loss.parameters() if p.requires_grad], 1e-2)
        for _ in range(400):
            losses = loss(rows)
            optimiser.zero_grad()
            (losses["loss_actor"] + losses["loss_qvalue"]).backward()
            optimiser.step()
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            means[temperature] = loss.actor_network(rows.select("loc"))["action"].mean().item()
    assert means[0.1] > 0.85
    assert abs(means[1e6]) < 0.5


@pytest.mark.parametrize(("name", "value"), [("temperature", 0.0), ("margin", 0.5), ("margin", 0.0)])
def test_impossible_arguments_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must"):
        make(**{name: value})


# tensordict asks for a setting of the compiler that no longer does anything.
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
def test_it_compiles_to_the_same_loss_and_gradients():
    loss, rows = make(), batch()
    loss.advantage = lambda td: torch.linspace(-1.0, 1.0, td.shape[0])

    def actor_loss(rows: TensorDict) -> torch.Tensor:
        return loss.actor_loss(rows)[0]

    values, gradients = [], []
    for function in (actor_loss, torch.compile(actor_loss, backend="aot_eager")):
        loss.zero_grad()
        values.append(function(rows))
        values[-1].backward()
        gradients.append([p.grad.clone() for p in loss.parameters() if p.grad is not None])
    torch.testing.assert_close(*values)
    torch.testing.assert_close(*gradients)
    assert gradients[0]


def test_renamed_and_nested_keys():
    def build(action_key, value_key) -> AWACLoss:
        torch.manual_seed(0)
        actor = gaussian_actor(SPEC, 3, hidden=(16,), action_key=action_key)
        loss = AWACLoss(actor, action_value(SPEC, 3, hidden=(16,), action_key=action_key, value_key=value_key))
        loss.set_keys(action=action_key, state_action_value=value_key)
        loss.make_value_estimator(gamma=0.9)
        SoftUpdate(loss, tau=0.05)
        return loss

    plain, nested = build("action", "state_action_value"), build(("agent", "move"), ("critic", "q"))
    assert torch.equal(nested.lowest, plain.lowest)
    rows = batch()
    renamed = rows.copy().set(("agent", "move"), rows["action"]).exclude("action")
    outs = []
    for loss, td in ((plain, rows), (nested, renamed)):
        torch.manual_seed(1)
        outs.append(loss(td))
    for key in ("loss_actor", "loss_qvalue"):
        torch.testing.assert_close(outs[0][key], outs[1][key])


def test_a_call_by_keyword_equals_one_with_a_tensordict():
    loss, rows = make(), batch()
    torch.manual_seed(1)
    expected = loss(rows.copy())
    tensors = {key if isinstance(key, str) else "_".join(key): value for key, value in rows.items(True, True)}
    torch.manual_seed(1)
    out = loss(**tensors)
    for key, value in zip(loss.out_keys, out, strict=True):
        assert torch.equal(value, expected[key])


def test_an_actor_without_bounds_is_refused():
    network = TensorDictModule(nn.Sequential(nn.Linear(3, 2), NormalParamExtractor()), ["loc"], ["l", "s"])
    actor = ProbabilisticActor(network, in_keys={"loc": "l", "scale": "s"}, distribution_class=TanhNormal)
    with pytest.raises(ValueError, match=r"AWACLoss needs an actor whose spec bounds one output.*0 of"):
        AWACLoss(actor, action_value(SPEC, 3))


def test_double_precision_gives_the_same_loss():
    loss, rows = make(), batch()
    loss.advantage = lambda td: torch.linspace(-1.0, 1.0, td.shape[0])
    single = loss(rows)["loss_actor"]
    double = loss.double()(rows.apply(lambda x: x.double() if x.is_floating_point() else x))["loss_actor"]
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), single, atol=1e-4, rtol=1e-4)
