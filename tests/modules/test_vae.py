"""The β-VAE's halves: layers, keys, interaction types and input checks."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torch import nn

from ls3_torchrl.modules import PixelDecoder, PixelEncoder
from ls3_torchrl.modules.vae import as_unit_pixels


def some_pixels(*batch: int, channels: int = 3) -> torch.Tensor:
    return torch.randint(0, 256, (*batch, channels, 64, 64), dtype=torch.uint8)


def layers_of(module: nn.Module, kind: type[nn.Module]) -> list:
    return [layer for layer in module.modules() if isinstance(layer, kind)]


def test_encoder_has_the_papers_convolutions():
    encoder = PixelEncoder()
    layers = layers_of(encoder, nn.Conv2d)
    assert [layer.in_channels for layer in layers] == [3, 32, 64, 128]
    assert [layer.out_channels for layer in layers] == [32, 64, 128, 256]
    assert [layer.kernel_size for layer in layers] == [(4, 4)] * 4
    # Hafner et al. use stride 2 throughout; the supplement changes the second layer to 3.
    assert [layer.stride for layer in layers] == [(2, 2), (3, 3), (2, 2), (2, 2)]


def test_encoder_shrinks_64_pixels_to_256_features_and_a_latent_of_32():
    encoder = PixelEncoder()
    sides = []
    handles = [
        layer.register_forward_hook(lambda module, args, out: sides.append(out.shape[-1]))
        for layer in layers_of(encoder, nn.Conv2d)
    ]
    td = encoder(TensorDict({"pixels": some_pixels(2)}, [2]))
    for handle in handles:
        handle.remove()
    assert sides == [31, 10, 4, 1]
    (head,) = layers_of(encoder, nn.Linear)
    assert (head.in_features, head.out_features) == (256, 2 * 32)
    assert td["loc"].shape == td["scale"].shape == td["latent"].shape == (2, 32)
    assert td["latent"].dtype == torch.float32


def test_decoder_has_hafners_transposed_convolutions():
    decoder = PixelDecoder()
    layers = layers_of(decoder, nn.ConvTranspose2d)
    assert [layer.in_channels for layer in layers] == [256, 128, 64, 32]
    assert [layer.out_channels for layer in layers] == [128, 64, 32, 3]
    assert [layer.kernel_size[0] for layer in layers] == [5, 5, 6, 6]
    assert [layer.stride for layer in layers] == [(2, 2)] * 4
    (first,) = layers_of(decoder, nn.Linear)
    assert (first.in_features, first.out_features) == (32, 256)


def test_stacked_frames_become_nine_channels_in_and_out():
    encoder, decoder = PixelEncoder(9, 4), PixelDecoder(9, 4)
    td = decoder(encoder(TensorDict({"pixels": some_pixels(2, channels=9)}, [2])))
    assert td["latent"].shape == (2, 4)
    assert td["reco_pixels"].shape == (2, 9, 64, 64)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_any_batch_shape_gives_the_same_rows(batch: tuple[int, ...]):
    encoder, decoder = PixelEncoder(latent_dim=4), PixelDecoder(latent_dim=4)
    pixels = some_pixels(*batch)
    td = decoder(encoder(TensorDict({"pixels": pixels}, batch)))
    assert td["latent"].shape == (*batch, 4)
    assert td["reco_pixels"].shape == (*batch, 3, 64, 64)
    last = pixels.reshape(-1, 3, 64, 64)[-1:]
    alone = decoder(encoder(TensorDict({"pixels": last}, [1])))
    torch.testing.assert_close(td["latent"].reshape(-1, 4)[-1:], alone["latent"], atol=1e-5, rtol=1e-4)
    reco = td["reco_pixels"].reshape(-1, 3, 64, 64)[-1:]
    torch.testing.assert_close(reco, alone["reco_pixels"], atol=1e-5, rtol=1e-4)


def test_bytes_and_unit_floats_are_the_same_image():
    encoder = PixelEncoder(latent_dim=4)
    pixels = some_pixels(2)
    from_bytes = encoder(TensorDict({"pixels": pixels}, [2]))
    for dtype in (torch.float32, torch.float64):
        from_floats = encoder(TensorDict({"pixels": pixels.to(dtype) / 255}, [2]))
        torch.testing.assert_close(from_bytes["loc"], from_floats["loc"], atol=1e-5, rtol=1e-4)
    # Black and white reach the network as 0 and 1.
    extremes = torch.tensor([0, 255], dtype=torch.uint8).view(2, 1, 1, 1).expand(2, 3, 64, 64)
    scaled = as_unit_pixels(extremes)
    assert (scaled[0] == 0).all()
    assert (scaled[1] == 1).all()


def test_latent_is_the_mean_unless_a_sample_is_asked_for():
    encoder = PixelEncoder(latent_dim=4)
    td = TensorDict({"pixels": some_pixels(2)}, [2])
    encoder(td)
    assert torch.equal(td["latent"], td["loc"])
    with set_interaction_type(InteractionType.RANDOM):
        first = encoder(td.clone())["latent"]
        second = encoder(td.clone())["latent"]
    assert not torch.equal(first, td["loc"])
    assert not torch.equal(first, second)


def test_sampled_latents_follow_the_posterior_and_carry_gradients():
    encoder = PixelEncoder(latent_dim=2)
    loc = torch.tensor([1.0, -2.0]).expand(20_000, 2).clone().requires_grad_()
    scale = torch.tensor([0.5, 3.0]).expand(20_000, 2)
    with set_interaction_type(InteractionType.RANDOM):
        latent = encoder[1](TensorDict({"loc": loc, "scale": scale}, [20_000]))["latent"]
    torch.testing.assert_close(latent.mean(0), torch.tensor([1.0, -2.0]), atol=0.08, rtol=0)
    torch.testing.assert_close(latent.std(0), torch.tensor([0.5, 3.0]), atol=0, rtol=0.03)
    # The reparameterisation z = loc + scale * noise has slope one in loc.
    latent.sum().backward()
    assert torch.equal(loc.grad, torch.ones_like(loc))


def test_get_dist_is_the_written_posterior():
    encoder = PixelEncoder(latent_dim=4)
    td = encoder(TensorDict({"pixels": some_pixels(2)}, [2]))
    posterior = encoder.get_dist(td)
    torch.testing.assert_close(posterior.mean, td["loc"])
    torch.testing.assert_close(posterior.stddev, td["scale"])


def test_scale_is_the_exponential_of_the_head_and_never_below_its_bound():
    encoder = PixelEncoder(latent_dim=3, min_scale=1e-3)
    (head,) = layers_of(encoder, nn.Linear)
    with torch.no_grad():
        head.weight.zero_()
        head.bias.copy_(torch.tensor([0.5, -0.5, 0.0, 0.0, 1.0, -100.0]))
    td = encoder(TensorDict({"pixels": some_pixels(1)}, [1]))
    torch.testing.assert_close(td["loc"][0], torch.tensor([0.5, -0.5, 0.0]))
    torch.testing.assert_close(td["scale"][0], torch.tensor([1.0, 2.718282, 1e-3]))


def test_decoder_does_not_clamp():
    decoder = PixelDecoder(latent_dim=2)
    last = layers_of(decoder, nn.ConvTranspose2d)[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.copy_(torch.tensor([-0.5, 0.5, 1.5]))
    reco = decoder(TensorDict({"latent": torch.zeros(1, 2)}, [1]))["reco_pixels"]
    assert reco[0, :, 0, 0].tolist() == [-0.5, 0.5, 1.5]


def test_nested_keys_reach_both_halves():
    encoder = PixelEncoder(
        latent_dim=4,
        pixels_key=("camera", "front"),
        loc_key=("posterior", "mean"),
        scale_key=("posterior", "std"),
        latent_key=("posterior", "z"),
    )
    decoder = PixelDecoder(latent_dim=4, latent_key=("posterior", "z"), reco_key=("camera", "reco"))
    td = decoder(encoder(TensorDict({"camera": {"front": some_pixels(2)}}, [2])))
    keys = td.keys(include_nested=True, leaves_only=True)
    assert set(keys) == {
        ("camera", "front"),
        ("camera", "reco"),
        ("posterior", "mean"),
        ("posterior", "std"),
        ("posterior", "z"),
    }
    assert encoder.in_keys == [("camera", "front")]
    assert decoder.in_keys == [("posterior", "z")]
    assert decoder.out_keys == [("camera", "reco")]


@pytest.mark.parametrize(
    "pixels",
    [
        torch.zeros(2, 64, 64, 3, dtype=torch.uint8),  # channels last
        torch.zeros(2, 9, 64, 64, dtype=torch.uint8),  # stacked frames for a single-frame encoder
        torch.zeros(2, 3, 84, 84, dtype=torch.uint8),  # another size
        torch.zeros(64, 64, dtype=torch.uint8),  # no channels
    ],
)
def test_wrong_image_shapes_are_refused(pixels: torch.Tensor):
    with pytest.raises(ValueError, match=r"must have shape \[\*B, 3, 64, 64\]"):
        PixelEncoder(latent_dim=4)(TensorDict({"pixels": pixels}, []))


@pytest.mark.parametrize("dtype", [torch.int64, torch.bool])
def test_wrong_image_dtypes_are_refused(dtype: torch.dtype):
    with pytest.raises(TypeError, match="uint8"):
        PixelEncoder(latent_dim=4)(TensorDict({"pixels": some_pixels(2).to(dtype)}, [2]))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_images_that_are_not_finite_are_refused(bad: float):
    pixels = torch.zeros(2, 3, 64, 64)
    pixels[1, 2, 3, 4] = bad
    with pytest.raises(ValueError, match="1 of 24576 values are NaN or infinite"):
        PixelEncoder(latent_dim=4)(TensorDict({"pixels": pixels}, [2]))


def test_missing_keys_are_named():
    with pytest.raises(KeyError, match="pixels"):
        PixelEncoder(latent_dim=4)(TensorDict({"image": some_pixels(2)}, [2]))
    with pytest.raises(KeyError, match=r"PixelDecoder needs the keys \['latent'\].*It has: z"):
        PixelDecoder(latent_dim=4)(TensorDict({"z": torch.zeros(2, 4)}, [2]))


def test_sizes_below_one_are_refused():
    with pytest.raises(ValueError, match="in_channels must be at least 1"):
        PixelEncoder(in_channels=0)
    with pytest.raises(ValueError, match="latent_dim must be at least 1"):
        PixelEncoder(latent_dim=0)


def test_rescaled_latents_are_the_same_posteriors_in_another_unit_and_decode_alike():
    torch.manual_seed(0)
    encoder, decoder = PixelEncoder(latent_dim=4), PixelDecoder(latent_dim=4)
    td = TensorDict({"pixels": some_pixels(3)}, [3])
    before = decoder(encoder(td.clone()))
    encoder.rescale(2.5)
    decoder.rescale(2.5)
    after = decoder(encoder(td.clone()))
    for key in ("loc", "scale", "latent"):
        torch.testing.assert_close(after[key], 2.5 * before[key])
    torch.testing.assert_close(after["reco_pixels"], before["reco_pixels"])


@pytest.mark.parametrize("factor", [0.0, -1.0, float("inf"), float("nan")])
@pytest.mark.parametrize("half", [PixelEncoder, PixelDecoder])
def test_impossible_units_are_refused(half, factor):
    with pytest.raises(ValueError, match="factor must be a finite number above 0"):
        half(latent_dim=4).rescale(factor)


def test_a_background_is_added_to_what_the_network_draws_and_is_kept_with_it():
    torch.manual_seed(0)
    plain, decoder = PixelDecoder(latent_dim=4), PixelDecoder(latent_dim=4, background=True)
    decoder.network.load_state_dict(plain.network.state_dict())
    z, image = torch.randn(3, 4), torch.rand(3, 64, 64)
    drawn = plain(TensorDict({"latent": z}, [3]))["reco_pixels"]
    torch.testing.assert_close(decoder(TensorDict({"latent": z}, [3]))["reco_pixels"], drawn)
    decoder.set_background(image)
    copy = PixelDecoder(latent_dim=4, background=True)
    copy.load_state_dict(decoder.state_dict())
    for one in (decoder, copy):
        torch.testing.assert_close(one(TensorDict({"latent": z}, [3]))["reco_pixels"], drawn + image)
    assert "background" not in plain.state_dict()
    with pytest.raises(RuntimeError, match="background=True"):
        plain.set_background(image)


def test_the_decoder_compiles_as_one_graph_with_the_same_gradients():
    torch.manual_seed(0)
    decoder = PixelDecoder(latent_dim=4)
    latent = torch.randn(3, 4)

    def error(latent: torch.Tensor) -> torch.Tensor:
        return decoder.network(latent).square().mean()

    compiled = torch.compile(error, fullgraph=True, backend="aot_eager")
    results = [torch.autograd.grad(f(latent), list(decoder.parameters())) for f in (error, compiled)]
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("as_floats", [False, True])
@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_both_halves_compute_in_the_dtype_they_were_moved_to(dtype: torch.dtype, as_floats: bool):
    encoder, decoder = PixelEncoder(latent_dim=4), PixelDecoder(latent_dim=4, background=True)
    decoder.set_background(torch.rand(3, 64, 64))
    pixels = some_pixels(2) / 255 if as_floats else some_pixels(2)
    before = decoder(encoder(TensorDict({"pixels": pixels}, [2])))
    after = decoder.to(dtype)(encoder.to(dtype)(TensorDict({"pixels": pixels}, [2])))
    for key in ("loc", "scale", "latent", "reco_pixels"):
        assert after[key].dtype == dtype
        tolerance = 1e-5 if dtype == torch.float64 else 0.02
        torch.testing.assert_close(after[key], before[key].to(dtype), atol=tolerance, rtol=tolerance)
    after["reco_pixels"].sum().backward()
    assert all(p.grad.dtype == dtype for p in [*encoder.parameters(), *decoder.parameters()])


def test_bytes_are_scaled_in_double_precision_where_it_is_asked_for():
    pixels = torch.tensor([[[[51]]]], dtype=torch.uint8)
    assert as_unit_pixels(pixels, torch.float64).item() == 51 / 255
    assert as_unit_pixels(pixels).dtype == torch.float32
