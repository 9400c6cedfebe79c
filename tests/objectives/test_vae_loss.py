"""Equation (1) restated by hand: squared error plus β times the KL divergence."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from ls3_torchrl.modules import PixelDecoder, PixelEncoder
from ls3_torchrl.objectives import VAELoss

LOC = (0.5, -1.0)
SCALE = (0.5, 2.0)
# KL(N(m, s²) || N(0, 1)) = (s² + m² - 1) / 2 - log s for each latent dimension.
KL = [0.5 * (s * s + m * m - 1) - math.log(s) for m, s in zip(LOC, SCALE, strict=True)]


def constant_vae(reconstruction: float, **options: object) -> VAELoss:
    """An encoder and a decoder that answer every image with the same posterior and the same grey."""
    encoder, decoder = PixelEncoder(latent_dim=2), PixelDecoder(latent_dim=2)
    (head,) = [layer for layer in encoder.modules() if isinstance(layer, nn.Linear)]
    last = [layer for layer in decoder.modules() if isinstance(layer, nn.ConvTranspose2d)][-1]
    with torch.no_grad():
        head.weight.zero_()
        head.bias.copy_(torch.tensor([*LOC, *(math.log(s) for s in SCALE)]))
        last.weight.zero_()
        last.bias.fill_(reconstruction)
    return VAELoss(encoder, decoder, **options)


def greys(*values: float) -> Tensor:
    return torch.tensor(values).view(-1, 1, 1, 1).repeat(1, 3, 64, 64)


class _Recorder(nn.Module):
    """A decoder that shows the mean of its latent as a grey image and remembers what it was given."""

    def forward(self, latent: Tensor) -> Tensor:
        self.latent = latent
        return latent.mean(-1).view(-1, 1, 1, 1).expand(-1, 3, 64, 64)


class _Posterior(nn.Module):
    """A posterior that depends on no image, with parameters to differentiate."""

    def __init__(self, latent_dim: int) -> None:
        super().__init__()
        self.loc = nn.Parameter(torch.full((latent_dim,), 0.3))
        self.scale = nn.Parameter(torch.full((latent_dim,), 2.0))

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        rows = (pixels.shape[0], -1)
        return self.loc.expand(*rows), self.scale.expand(*rows)


def recording_vae(latent_dim: int, **options: object) -> tuple[VAELoss, _Posterior, _Recorder]:
    encoder, decoder = PixelEncoder(latent_dim=latent_dim), PixelDecoder(latent_dim=latent_dim)
    encoder[0].module, decoder.network = _Posterior(latent_dim), _Recorder()
    return VAELoss(encoder, decoder, **options), encoder[0].module, decoder.network


def test_mean_reduction_averages_pixels_and_latent_dimensions():
    out = constant_vae(0.25, beta=0.1)(TensorDict({"pixels": greys(1.0, 0.5)}, [2]))
    error = ((0.25 - 1.0) ** 2 + (0.25 - 0.5) ** 2) / 2
    kl = sum(KL) / 2
    assert out["reconstruction"].item() == pytest.approx(error)
    assert out["kl"].item() == pytest.approx(kl)
    assert out["loss_vae"].item() == pytest.approx(error + 0.1 * kl)


def test_sum_reduction_is_equation_1_to_the_letter():
    out = constant_vae(0.25, beta=0.1, reduction="sum")(TensorDict({"pixels": greys(1.0, 0.5)}, [2]))
    # The squared norm over all pixels of an image and the KL of the whole posterior; batch average.
    error = 3 * 64 * 64 * ((0.25 - 1.0) ** 2 + (0.25 - 0.5) ** 2) / 2
    kl = sum(KL)
    assert out["reconstruction"].item() == pytest.approx(error)
    assert out["kl"].item() == pytest.approx(kl)
    assert out["loss_vae"].item() == pytest.approx(error + 0.1 * kl)


def test_default_beta_is_table_1s():
    loss = constant_vae(0.0)
    assert (loss.beta, loss.reduction) == (1e-6, "mean")


def test_kl_of_a_standard_normal_posterior_is_zero():
    loss, posterior, _ = recording_vae(4, beta=1.0)
    with torch.no_grad():
        posterior.loc.zero_()
        posterior.scale.fill_(1.0)
    assert loss(TensorDict({"pixels": greys(0.5)}, [1]))["kl"].item() == pytest.approx(0.0, abs=1e-7)


def test_the_decoder_is_given_a_sample_of_the_posterior():
    loss, _, recorder = recording_vae(32)
    batch = TensorDict({"pixels": greys(*[0.5] * 64)}, [64])
    out = loss(batch)
    first = recorder.latent.detach()
    assert first.mean().item() == pytest.approx(0.3, abs=0.15)
    assert first.std().item() == pytest.approx(2.0, rel=0.06)
    by_hand = sum((z.mean().item() - 0.5) ** 2 for z in first) / 64
    assert out["reconstruction"].item() == pytest.approx(by_hand, rel=1e-4)
    loss(batch)
    assert not torch.equal(recorder.latent, first)


def test_the_sample_is_reparameterised():
    loss, posterior, recorder = recording_vae(1, beta=0.0)
    loss(TensorDict({"pixels": greys(0.5)}, [1]))["loss_vae"].backward()
    # (z - v)² with z = loc + scale * noise: slope 2 (z - v) in loc and 2 (z - v) * noise in scale.
    z = recorder.latent.item()
    noise = (z - 0.3) / 2.0
    assert posterior.loc.grad.item() == pytest.approx(2 * (z - 0.5), rel=1e-4)
    assert posterior.scale.grad.item() == pytest.approx(2 * (z - 0.5) * noise, rel=1e-4)


def test_kl_alone_pulls_the_posterior_to_the_prior():
    loss, posterior, recorder = recording_vae(1, beta=3.0)
    loss(TensorDict({"pixels": greys(0.5)}, [1]))["loss_vae"].backward()
    z = recorder.latent.item()
    # d KL / d loc = loc; the rest is the reconstruction's slope.
    assert posterior.loc.grad.item() == pytest.approx(2 * (z - 0.5) + 3.0 * 0.3, rel=1e-4)


def test_pixels_below_zero_keep_their_gradient():
    # A clamp of the reconstruction to [0, 1] in the loss would make this gradient zero.
    loss = constant_vae(-0.5)
    loss(TensorDict({"pixels": greys(0.25)}, [1]))["loss_vae"].backward()
    last = [layer for layer in loss.decoder.modules() if isinstance(layer, nn.ConvTranspose2d)][-1]
    # Each of the three channels' biases moves a third of the averaged error.
    torch.testing.assert_close(last.bias.grad, torch.full((3,), 2 * (-0.5 - 0.25) / 3))


def test_reported_parts_are_detached():
    out = constant_vae(0.25)(TensorDict({"pixels": greys(1.0)}, [1]))
    assert out.batch_size == torch.Size([])
    assert out["loss_vae"].requires_grad
    assert not out["reconstruction"].requires_grad
    assert not out["kl"].requires_grad


def test_an_augmented_input_is_compared_with_the_clean_target():
    loss = constant_vae(0.25)
    loss.set_keys(pixels=("augmented", "pixels"), target=("clean", "pixels"))
    batch = TensorDict({"augmented": {"pixels": greys(0.9)}, "clean": {"pixels": greys(0.5)}}, [1])
    assert loss(batch)["reconstruction"].item() == pytest.approx((0.25 - 0.5) ** 2)


def test_bytes_and_floats_give_one_loss():
    loss = constant_vae(0.25)
    as_bytes = TensorDict({"pixels": torch.full((2, 3, 64, 64), 51, dtype=torch.uint8)}, [2])
    assert loss(as_bytes)["reconstruction"].item() == pytest.approx((0.25 - 0.2) ** 2, rel=1e-5)


def test_in_double_precision_the_images_are_scaled_in_it():
    loss = constant_vae(0.25).double()
    out = loss(TensorDict({"pixels": torch.full((2, 3, 64, 64), 51, dtype=torch.uint8)}, [2]))
    assert out["reconstruction"].item() == pytest.approx((0.25 - 0.2) ** 2, rel=1e-12)


def test_modules_with_keys_of_their_own_and_an_untouched_batch():
    encoder = PixelEncoder(
        latent_dim=2, pixels_key=("a", "x"), loc_key=("b", "m"), scale_key=("b", "s"), latent_key=("b", "z")
    )
    decoder = PixelDecoder(latent_dim=2, latent_key=("c", "z"), reco_key=("c", "x"))
    loss = VAELoss(encoder, decoder)
    loss.set_keys(pixels=("camera", "front"))
    batch = TensorDict({"camera": {"front": greys(0.1, 0.9)}}, [2])
    loss(batch)["loss_vae"].backward()
    assert all(p.grad is not None for p in loss.parameters())
    assert list(batch.keys(include_nested=True, leaves_only=True)) == [("camera", "front")]


def test_misspelt_and_missing_keys():
    loss = constant_vae(0.25)
    with pytest.raises(ValueError, match="pixel is not an accepted tensordict key"):
        loss.set_keys(pixel="image")
    with pytest.raises(KeyError, match=r"VAELoss needs the keys \['pixels'\].*It has: image"):
        loss(TensorDict({"image": greys(0.5)}, [1]))
    loss.set_keys(target="clean")
    with pytest.raises(KeyError, match="clean"):
        loss(TensorDict({"pixels": greys(0.5)}, [1]))


def test_loss_names_its_keys():
    loss = constant_vae(0.25)
    assert loss.in_keys == ["pixels"]
    loss.set_keys(target=("clean", "pixels"))
    assert loss.in_keys == ["pixels", ("clean", "pixels")]
    assert loss.out_keys == ["loss_vae", "reconstruction", "kl"]
    assert "loss_vae" in repr(loss)


def test_bad_options_are_refused():
    with pytest.raises(ValueError, match="beta must not be negative"):
        constant_vae(0.25, beta=-1e-6)
    with pytest.raises(ValueError, match="reduction must be one of 'mean', 'sum'"):
        constant_vae(0.25, reduction="none")


def test_encoder_and_decoder_overfit_four_images(minimise):
    # Four white bands. Errors below the variance about the mean image need the latent to say which one it is.
    pixels = torch.zeros(4, 3, 64, 64, dtype=torch.uint8)
    for i in range(4):
        pixels[i, :, 16 * i : 16 * (i + 1)] = 255
    images = pixels / 255
    variance = (images - images.mean(0)).square().mean().item()
    loss = VAELoss(PixelEncoder(latent_dim=4), PixelDecoder(latent_dim=4))
    first, last = minimise(loss, TensorDict({"pixels": pixels}, [4]), "loss_vae", steps=60, lr=1e-3)
    assert first > variance
    assert last < 0.25 * variance


# Encoders and decoders of other makes


class _Brightness(nn.Module):
    """Any image to a posterior around its brightness, in bytes."""

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        self.seen = images
        mean = images.to(torch.float32).mean((-3, -2, -1)).unsqueeze(-1) / 255
        return mean, torch.full_like(mean, 0.5)


def of_another_make(size: int, keys: tuple, decoder_keys: tuple) -> tuple[TensorDictModule, TensorDictModule]:
    encoder = TensorDictModule(_Brightness(), [keys[0]], list(keys[1:]))
    decoder = nn.Sequential(nn.Linear(1, 3 * size * size), nn.Unflatten(-1, (3, size, size)))
    return encoder, TensorDictModule(decoder, [decoder_keys[0]], [decoder_keys[1]])


@pytest.mark.parametrize(
    ("keys", "decoder_keys"),
    [
        (("pixels", "loc", "scale"), ("latent", "reco_pixels")),
        ((("eye", "x"), ("q", "loc"), ("q", "scale")), (("q", "z"), ("eye", "reco"))),
    ],
)
@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_any_encoder_and_decoder_of_any_images(keys: tuple, decoder_keys: tuple, reduction: str):
    encoder, decoder = of_another_make(8, keys, decoder_keys)
    loss = VAELoss(encoder, decoder, beta=0.1, reduction=reduction)
    loss.set_keys(pixels=("camera", "front"))
    images = torch.randint(256, (4, 3, 8, 8), dtype=torch.uint8)
    torch.manual_seed(1)
    out = loss(TensorDict({"camera": {"front": images}}, [4]))
    assert encoder.module.seen is images  # as they are in the batch: only PixelEncoder is known to take floats as well
    torch.manual_seed(1)
    loc = images.float().mean((1, 2, 3))[:, None] / 255
    made = decoder.module(loc + 0.5 * torch.randn(4, 1))
    error = (made - images / 255).square()
    kl = (0.5 * (0.25 + loc**2 - 1) - math.log(0.5)).mean()
    by_hand = (error.mean() if reduction == "mean" else error.sum() / 4) + 0.1 * kl
    torch.testing.assert_close(out["loss_vae"], by_hand)
    out["loss_vae"].backward()
    assert decoder.module[0].weight.grad.abs().sum() > 0


def test_states_can_be_encoded_as_well_as_images():
    class Wide(nn.Module):
        def forward(self, state: Tensor) -> tuple[Tensor, Tensor]:
            return state[..., :1], torch.ones_like(state[..., :1])

    encoder = TensorDictModule(Wide(), ["state"], ["loc", "scale"])
    decoder = TensorDictModule(nn.Linear(1, 5), ["latent"], ["reco"])
    loss = VAELoss(encoder, decoder)
    loss.set_keys(pixels="state")
    state = torch.randn(4, 5)
    torch.manual_seed(1)
    out = loss(state=state)
    torch.manual_seed(1)
    torch.testing.assert_close(out[1], (decoder.module(state[:, :1] + torch.randn(4, 1)) - state).square().mean())


def test_a_subclass_of_the_pixel_encoder_is_not_bypassed():
    class Darkened(PixelEncoder):
        def forward(self, tensordict: TensorDict) -> TensorDict:
            assert tensordict["pixels"].dtype == torch.uint8
            tensordict = super().forward(tensordict.set("pixels", tensordict["pixels"] // 4))
            return tensordict.set("loc", 5.0 + 0.0 * tensordict["loc"])

    loss = VAELoss(Darkened(latent_dim=2), PixelDecoder(latent_dim=2))
    out = loss(TensorDict({"pixels": torch.full((2, 3, 64, 64), 51, dtype=torch.uint8)}, [2]))
    # A mean of 5 in each dimension is 12.5 nats from the prior; an encoder's own forward gives about 2.
    assert out["kl"].item() > 12.5


def test_hooks_of_the_pixel_encoder_are_called():
    encoder, calls = PixelEncoder(latent_dim=2), []
    encoder.register_forward_hook(lambda *_: calls.append(1))
    VAELoss(encoder, PixelDecoder(latent_dim=2))(TensorDict({"pixels": greys(0.5)}, [1]))
    assert calls == [1]


@pytest.mark.parametrize("out_keys", [["latent"], ["loc"], ["z"]])
def test_an_encoder_without_a_standard_deviation_is_refused(out_keys: list[str]):
    encoder = TensorDictModule(nn.Flatten(), ["pixels"], out_keys)
    with pytest.raises(ValueError, match=r"VAELoss needs an encoder .*'scale'; TensorDictModule writes .*Prediction"):
        VAELoss(encoder, PixelDecoder(latent_dim=2))


def test_images_that_the_decoder_does_not_make_are_refused():
    encoder, decoder = of_another_make(8, ("pixels", "loc", "scale"), ("latent", "reco"))
    with pytest.raises(ValueError, match=r"decoder writes images of shape \[2, 3, 8, 8\] .* shape \[2, 3, 64, 64\]"):
        VAELoss(encoder, decoder)(TensorDict({"pixels": greys(0.1, 0.2)}, [2]))
