"""Convolutions made for speed against PyTorch's own."""

import pytest
import torch
from torch import nn

from ls3_torchrl.modules import PixelDecoder, PixelEncoder


@pytest.mark.parametrize("autocast", [False, True])
@pytest.mark.parametrize(
    ("kind", "which", "size"),
    [(nn.Conv2d, 0, 4), *((nn.ConvTranspose2d, i, size) for i, size in enumerate((1, 5, 13, 30)))],
)
def test_layers_made_for_speed_equal_the_convolution_with_its_gradients(
    kind: type, which: int, size: int, autocast: bool
):
    torch.manual_seed(0)
    modules = [*PixelEncoder(latent_dim=4).modules(), *PixelDecoder(latent_dim=4).modules()]
    layer = [m for m in modules if isinstance(m, kind) and type(m) is not kind][which]
    with torch.no_grad():
        layer.bias += torch.randn_like(layer.bias)  # a bias that matters
    x = torch.randn(3, layer.in_channels, size, size, requires_grad=True)
    weight = None
    results = []
    for forward in (layer.forward, lambda x: kind.forward(layer, x)):
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            out = forward(x)
        weight = torch.randn_like(out) if weight is None else weight
        results.append([out, *torch.autograd.grad((weight * out).sum(), [x, *layer.parameters()])])
    for ours, theirs in zip(*results, strict=True):
        assert ours.dtype == theirs.dtype
        # Of the largest value; bf16 keeps eight bits.
        tolerance = (0.02 if autocast else 1e-4) * float(theirs.detach().abs().max())
        torch.testing.assert_close(ours, theirs, atol=tolerance, rtol=1e-4)
