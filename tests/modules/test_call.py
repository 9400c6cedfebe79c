"""How networks and encoders of any keys are called."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictParams,
    set_interaction_type,
)
from torch import Tensor, nn
from torch.distributions import Normal

from ls3_torchrl.modules import PixelEncoder, SafeSet, ValueEnsemble, probability_of
from ls3_torchrl.modules.call import (
    Weights,
    asks_of_latent_alone,
    call_on_latent,
    call_with_params,
    encode,
    posterior_keys,
)


def module(out_keys: list, in_keys: list | None = None) -> TensorDictModule:
    return TensorDictModule(lambda x: (x,) * len(out_keys), in_keys or ["state"], out_keys)


def params_of(network: nn.Module, factor: float) -> TensorDictParams:
    return TensorDictParams(TensorDict.from_module(network).detach().apply(lambda p: factor * p), no_convert=True)


# Networks of a latent


@pytest.mark.parametrize("keys", [("latent", "out"), (("model", "z"), ("model", "out"))])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_the_first_output_of_a_network_whatever_its_keys(keys: tuple, batch: tuple):
    linear = nn.Linear(8, 1)
    latent = torch.randn(*batch, 8)
    out = call_on_latent(TensorDictModule(linear, [keys[0]], [keys[1]]), latent)
    assert torch.equal(out, linear(latent))


def test_the_first_of_several_outputs():
    safe_set = SafeSet(8, hidden=(16,), prob_key="p")
    latent = torch.randn(4, 8)
    assert torch.equal(call_on_latent(safe_set, latent), safe_set.network(latent))
    assert torch.equal(probability_of(safe_set, latent), safe_set.network(latent).sigmoid())


def test_options_reach_the_network():
    value, latent = ValueEnsemble(8, hidden=(16,)), torch.randn(4, 5, 8)
    by_hand = value.network(latent, per_member=True)
    assert torch.equal(call_on_latent(value, latent, per_member=True), by_hand)


def test_other_weights_take_the_place_of_the_networks_own_for_one_call():
    network = TensorDictModule(nn.Linear(8, 1, bias=False), ["latent"], [("a", "out")])
    latent, own = torch.randn(4, 8), network.module.weight.detach().clone()
    other = params_of(network, -2.0)
    out = call_on_latent(network, latent, params=other)
    torch.testing.assert_close(out, -2.0 * network.module(latent))
    assert torch.equal(network.module.weight, own)
    # The other weights are left as they are, too: a target network's ask for no gradient.
    assert not any(p.requires_grad for p in other.values(True, True))
    assert network.module.weight.requires_grad


def test_other_weights_of_a_network_of_several_inputs():
    network = TensorDictModule(nn.Bilinear(3, 2, 1, bias=False), ["x", ("b", "y")], ["out"])
    td = TensorDict({"x": torch.randn(4, 3), "b": {"y": torch.randn(4, 2)}}, [4])
    out = call_with_params(network, params_of(network, 3.0), td.copy())["out"]
    torch.testing.assert_close(out, 3.0 * network(td)["out"])


# Encoders


@pytest.mark.parametrize(
    ("out_keys", "found"),
    [
        (["loc", "scale"], ("loc", "scale")),
        (["scale", "features", "loc"], ("loc", "scale")),
        ([("q", "loc"), ("q", "scale"), "latent"], (("q", "loc"), ("q", "scale"))),
        (["loc"], ("loc", None)),
        (["latent"], ("latent", None)),
        (["features", ("m", "latent")], (("m", "latent"), None)),
        (["z"], ("z", None)),
        ([("m", "z")], (("m", "z"), None)),
    ],
)
def test_where_an_encoder_writes_its_posterior(out_keys: list, found: tuple):
    assert posterior_keys(module(out_keys)) == found


def test_an_encoder_may_name_its_keys():
    encoder = PixelEncoder(latent_dim=2, loc_key=("q", "m"), scale_key="s")
    assert posterior_keys(encoder) == (("q", "m"), "s")


def test_an_encoder_of_outputs_without_meaning_is_refused():
    with pytest.raises(ValueError, match=r"must write 'loc' \(and 'scale'\), 'latent', or a single key.*\['x', 'y'\]"):
        posterior_keys(module(["x", "y"]))


def test_encode_gives_the_pixel_encoders_posterior_and_leaves_the_tensordict_as_it_is():
    encoder = PixelEncoder(latent_dim=4)
    td = TensorDict({"pixels": torch.randint(256, (3, 3, 64, 64), dtype=torch.uint8), "other": torch.zeros(3)}, [3])
    loc, scale = encode(encoder, td)
    assert set(td.keys()) == {"pixels", "other"}
    written = encoder(td)
    assert torch.equal(loc, written["loc"])
    assert torch.equal(scale, written["scale"])


def test_a_certain_encoder_has_no_spread():
    state = torch.randn(3, 4)
    loc, scale = encode(module(["latent"]), TensorDict({"state": state}, [3]))
    assert torch.equal(loc, state)
    assert torch.equal(scale, torch.zeros(3, 4))


def test_an_encoder_that_samples_is_asked_for_its_middle():
    sample = ProbabilisticTensorDictModule(
        in_keys={"loc": "m", "scale": "s"}, out_keys=["latent"], distribution_class=Normal
    )
    parameters = TensorDictModule(lambda x: (x, torch.ones_like(x)), ["state"], ["m", "s"])
    encoder = ProbabilisticTensorDictSequential(parameters, sample)
    state = torch.randn(3, 4)
    with set_interaction_type(InteractionType.RANDOM):
        loc, _ = encode(encoder, TensorDict({"state": state}, [3]))
    assert torch.equal(loc, state)


def test_a_forward_of_ones_own_is_not_bypassed():
    class Doubling(PixelEncoder):
        def forward(self, tensordict: TensorDict) -> TensorDict:
            tensordict = super().forward(tensordict)
            return tensordict.set("loc", 2 * tensordict["loc"])

    encoder = Doubling(latent_dim=4)
    td = TensorDict({"pixels": torch.randint(256, (3, 3, 64, 64), dtype=torch.uint8)}, [3])
    inner: Tensor = encoder[0](td.copy())["loc"]
    assert torch.equal(encode(encoder, td)[0], 2 * inner)


# Weights in the place of a network's own


def test_weights_in_place_are_those_of_a_functional_call_and_the_own_ones_come_back():
    safe_set, latent = SafeSet(8), torch.randn(4, 8)
    own = dict(safe_set.named_parameters())
    weights = Weights(safe_set, params_of(safe_set, 0.5))
    expected = torch.func.functional_call(safe_set, weights.by_name, (TensorDict({"latent": latent}, [4]),))
    assert torch.equal(call_on_latent(safe_set, latent, params=weights), expected["safe_set_logit"])
    with pytest.raises(ValueError, match="shape"), weights.in_place():
        safe_set.of_latent(torch.randn(4, 9))
    assert all(parameter is own[name] for name, parameter in safe_set.named_parameters())


def test_buffers_are_replaced_as_well():
    network = TensorDictModule(nn.BatchNorm1d(2).eval(), ["latent"], ["out"])
    latent = torch.ones(3, 2)
    params = params_of(network, 1.0)
    params.data["module", "running_mean"].fill_(1.0)
    assert call_on_latent(network, latent, params=Weights(network, params)).abs().max() == 0.0
    assert call_on_latent(network, latent).min() > 0.9


# Modules that are asked for what their forward writes


class Shifted(SafeSet):
    def of_latent(self, latent: Tensor) -> Tensor:
        return super().of_latent(latent) + 1.0


class Squared(SafeSet):
    def forward(self, tensordict: TensorDict) -> TensorDict:
        out = super().forward(tensordict)
        return out.set("safe_set_logit", out["safe_set_logit"] ** 2)


def test_a_module_is_asked_directly_where_nothing_is_bypassed():
    assert asks_of_latent_alone(SafeSet(8))
    assert asks_of_latent_alone(ValueEnsemble(8))
    assert not asks_of_latent_alone(module(["out"]))
    assert not asks_of_latent_alone(Squared(8))


@pytest.mark.parametrize("kind", [SafeSet, Shifted, Squared])
def test_the_direct_answer_is_that_of_a_call(kind: type):
    network, latent = kind(8), torch.randn(4, 8)
    assert torch.equal(call_on_latent(network, latent), network(TensorDict({"latent": latent}, [4]))["safe_set_logit"])


def test_hooks_and_a_replaced_forward_are_called():
    network, seen = SafeSet(8), []
    network.register_forward_hook(lambda *_: seen.append("hook"))
    call_on_latent(network, torch.randn(4, 8))
    other = SafeSet(8)
    forward = other.forward
    other.forward = lambda tensordict: seen.append("own") or forward(tensordict)
    call_on_latent(other, torch.randn(4, 8))
    assert seen == ["hook", "own"]
