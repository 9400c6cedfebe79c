"""Actors stay in the box, critics see actions in its units, and images are read where latents are not."""

import pytest
import torch
from tensordict import NestedKey, TensorDict
from torchrl.data import Bounded
from torchrl.envs import ExplorationType, set_exploration_type

from ls3_torchrl.baselines import PixelFeatures, action_bounds, action_value, deterministic_actor, gaussian_actor

LOW, HIGH = torch.tensor([-3.0, 0.0]), torch.tensor([1.0, 0.02])


def box(*batch: int) -> Bounded:
    return Bounded(low=LOW.expand(*batch, 2), high=HIGH.expand(*batch, 2), shape=(*batch, 2))


def rows(count: int = 500) -> TensorDict:
    return TensorDict({"loc": 3.0 * torch.randn(count, 4)}, [count])


def test_bounds_of_one_action_or_of_a_batch():
    for spec in (box(), box(7)):
        low, high = action_bounds(spec)
        assert torch.equal(low, LOW)
        assert torch.equal(high, HIGH)


@pytest.mark.parametrize("low", [-float("inf"), 1.0])
def test_boxes_without_inside_are_refused(low):
    spec = Bounded(low=-1.0, high=1.0, shape=(2,))
    spec.space.low = torch.full((2,), low)
    with pytest.raises(ValueError, match="finite bounds, low below high"):
        action_bounds(spec)


@pytest.mark.parametrize("make", [gaussian_actor, deterministic_actor])
def test_actions_lie_in_the_box_and_use_it(make):
    with set_exploration_type(ExplorationType.RANDOM):
        action = make(box(), 4, hidden=(8,))(rows())["action"]
    assert ((action >= LOW) & (action <= HIGH)).all()
    assert (action.std(0) > 0.02 * (HIGH - LOW)).all()


def test_an_untrained_actor_is_as_wide_as_asked_and_its_middle_has_no_noise():
    for std in (0.1, 1.0):
        actor = gaussian_actor(box(), 4, hidden=(), initial_std=std)
        for parameter in actor.parameters():
            torch.nn.init.zeros_(parameter)
        made = actor(rows())
        torch.testing.assert_close(made["action_scale"], torch.full((500, 2), std), atol=1e-3, rtol=0.01)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        middle = actor(rows())["action"]
    torch.testing.assert_close(middle, ((LOW + HIGH) / 2).expand(500, 2))


def test_log_probabilities_by_hand():
    actor = gaussian_actor(box(), 4, hidden=(8,))
    with set_exploration_type(ExplorationType.RANDOM):
        td = actor(rows(6))
    half, middle = (HIGH - LOW) / 2, (HIGH + LOW) / 2
    before = torch.atanh((td["action"] - middle) / half)
    normal = torch.distributions.Normal(td["action_loc"], td["action_scale"]).log_prob(before)
    # The density is stretched by the slope of half * tanh.
    by_hand = (normal - torch.log(half * (1 - torch.tanh(before) ** 2))).sum(-1)
    torch.testing.assert_close(td["action_log_prob"], by_hand, atol=1e-2, rtol=1e-2)


def test_the_critic_sees_actions_in_units_of_half_the_box():
    critic = action_value(box(), 4, hidden=(8,))
    inner = critic.module[1]
    z, action = torch.randn(6, 4), LOW + (HIGH - LOW) * torch.rand(6, 2)
    value = critic(TensorDict({"loc": z, "action": action}, [6]))["state_action_value"]
    unit = 2 * (action - LOW) / (HIGH - LOW) - 1
    torch.testing.assert_close(value, inner(torch.cat([z, unit], -1)))


@pytest.mark.parametrize("make", [gaussian_actor, deterministic_actor, action_value])
def test_networks_read_images_through_features_of_their_own(make):
    network = make(box(), PixelFeatures.size, observation_key="pixels", features=PixelFeatures(6), hidden=(8,))
    pixels = torch.randint(256, (3, 6, 64, 64), dtype=torch.uint8)
    td = network(TensorDict({"pixels": pixels, "action": torch.zeros(3, 2)}, [3]))
    out = td["state_action_value" if make is action_value else "action"]
    assert out.shape[0] == 3
    out.sum().backward()
    gradients = [p.grad for name, p in network.named_parameters() if "convolutions" in name]
    assert gradients
    assert any(g is not None and g.abs().sum() > 0 for g in gradients)


@pytest.mark.parametrize("key", ["move", ("agent", "move")])
def test_actors_and_critics_take_their_keys(key: NestedKey):
    def beside(name: str) -> NestedKey:
        return f"move_{name}" if key == "move" else ("agent", f"move_{name}")

    observation = ("robot", "state")
    td = TensorDict({"robot": {"state": torch.randn(6, 4)}}, [6])
    actor = gaussian_actor(box(), 4, hidden=(8,), observation_key=observation, action_key=key)
    assert actor.in_keys == [observation]
    assert set(actor.out_keys) == {key, beside("loc"), beside("scale"), beside("log_prob")}
    written = actor(td.clone())
    assert written[key].shape == (6, 2)
    assert written[beside("log_prob")].shape == (6,)
    policy = deterministic_actor(box(), 4, hidden=(8,), observation_key=observation, action_key=key)
    action = policy(td.clone())[key]
    assert ((action >= LOW) & (action <= HIGH)).all()
    critic = action_value(box(), 4, hidden=(8,), observation_key=observation, action_key=key, value_key=("critic", "q"))
    assert critic.in_keys == [observation, key]
    value = critic(td.clone().set(key, action))["critic", "q"]
    torch.testing.assert_close(value, critic.module(td["robot", "state"], action))


def test_the_keys_of_an_actor_that_is_not_told_are_torchrls():
    assert gaussian_actor(box(), 4).out_keys == ["action_loc", "action_scale", "action", "action_log_prob"]
    assert deterministic_actor(box(), 4).out_keys == ["action"]
    assert action_value(box(), 4).out_keys == ["state_action_value"]


@pytest.mark.parametrize("pixels", [False, True])
@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("make", [gaussian_actor, deterministic_actor, action_value])
def test_networks_compute_in_the_dtype_they_were_moved_to(make, dtype: torch.dtype, pixels: bool):
    if pixels:
        network = make(box(), PixelFeatures.size, observation_key="pixels", features=PixelFeatures(3), hidden=(8,))
        td = TensorDict({"pixels": torch.randint(256, (3, 3, 64, 64), dtype=torch.uint8)}, [3])
    else:
        network, td = make(box(), 4, hidden=(8,)), rows(3)
    key = "state_action_value" if make is action_value else "action"
    if make is action_value:
        td["action"] = torch.tensor([[0.0, 0.01]]).expand(3, 2)
    before = network(td.clone())[key]
    # Actions stay as the environment has them, float32; a critic takes them beside observations of any dtype.
    after = network.to(dtype)(td.apply(lambda x: x.to(dtype) if x.is_floating_point() and x.shape[-1] != 2 else x))[key]
    assert after.dtype == (torch.float32 if make is gaussian_actor and dtype != torch.float64 else dtype)
    tolerance = 1e-5 if dtype == torch.float64 else 0.05
    torch.testing.assert_close(after.double(), before.double(), atol=tolerance, rtol=tolerance)
    after.sum().backward()
    assert all(p.grad.dtype == dtype for p in network.parameters() if p.grad is not None)
