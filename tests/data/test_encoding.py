import pytest
import torch
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModule, TensorDictSequential
from torch import nn
from torch.distributions import Normal

from ls3_torchrl.data.encoding import encode_frames
from ls3_torchrl.modules import PixelEncoder

FRAMES = torch.arange(10.0).reshape(5, 2)


def module(network, in_keys=("state",), out_keys=("latent",)):
    return TensorDictModule(network, in_keys=list(in_keys), out_keys=list(out_keys))


def test_a_certain_latent_has_no_spread():
    out = encode_frames(module(nn.Identity()), FRAMES, key="state", latent_dim=2)
    assert torch.equal(out["loc"], FRAMES)
    assert torch.equal(out["scale"], torch.zeros(5, 2))


@pytest.mark.parametrize("key", ["state", "camera", ("deep", "camera")])
def test_an_encoder_of_one_key_may_call_it_anything(key):
    out = encode_frames(module(nn.Identity(), in_keys=[("its", "own")]), FRAMES, key=key, latent_dim=2)
    assert torch.equal(out["loc"], FRAMES)


def test_an_encoder_of_another_key_as_well_is_told_what_is_missing():
    both = module(lambda state, goal: state - goal, in_keys=["state", "goal"])
    with pytest.raises(KeyError, match=r"The encoder needs the keys \['goal'\]"):
        encode_frames(both, FRAMES, key="state", latent_dim=2)


def test_means_are_taken_and_nothing_is_drawn():
    encoder = TensorDictSequential(
        module(lambda state: (state, state + 1), out_keys=[("q", "loc"), ("q", "scale")]),
        ProbabilisticTensorDictModule(
            in_keys={"loc": ("q", "loc"), "scale": ("q", "scale")}, out_keys=["latent"], distribution_class=Normal
        ),
    )
    before = torch.get_rng_state()
    out = encode_frames(encoder, FRAMES, key="state", latent_dim=2)
    assert torch.equal(out["loc"], FRAMES)
    assert torch.equal(out["scale"], FRAMES + 1)
    assert torch.equal(before, torch.get_rng_state())


def test_chunks_join_and_report_their_progress_without_gradients():
    torch.manual_seed(0)
    encoder, frames, calls = PixelEncoder(latent_dim=3), torch.randint(256, (7, 3, 64, 64), dtype=torch.uint8), []
    whole = encode_frames(encoder, frames, key="pixels", latent_dim=3)
    parts = encode_frames(encoder, frames, key="pixels", latent_dim=3, chunk=3, progress=lambda *now: calls.append(now))
    torch.testing.assert_close(parts, whole)
    assert calls == [(3, 7), (6, 7), (7, 7)]
    assert not parts["loc"].requires_grad


def test_latents_are_float32_whatever_the_encoder_writes():
    out = encode_frames(module(nn.Identity()), FRAMES.double(), key="state", latent_dim=2)
    assert out["loc"].dtype == out["scale"].dtype == torch.float32


def test_latents_of_another_size_are_refused():
    with pytest.raises(ValueError, match=r"latents of size 2.*latent_dim=3"):
        encode_frames(module(nn.Identity()), FRAMES, key="state", latent_dim=3)
    with pytest.raises(ValueError, match=r"must write latents \[5, 2\].*got \[5, 1, 2\].*Flatten"):
        encode_frames(module(nn.Unflatten(-1, (1, 2))), FRAMES, key="state", latent_dim=2)
