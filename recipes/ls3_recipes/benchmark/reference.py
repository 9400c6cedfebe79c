"""What the benchmark compares to: the same networks in eager PyTorch, with nothing done for speed."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from ls3_torchrl import LS3Agent


def reference_members(sizes: Sequence[int], count: int) -> list[nn.Sequential]:
    """``count`` separate ReLU networks with layers of the given sizes."""
    return [
        nn.Sequential(*(layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ReLU())))[:-1]
        for _ in range(count)
    ]


class ReferenceVAE(nn.Module):
    """The VAE's layers as PyTorch has them."""

    def __init__(self, agent: LS3Agent) -> None:
        super().__init__()

        def as_is(layer: nn.Module) -> nn.Module:
            for kind in (nn.Conv2d, nn.ConvTranspose2d):
                if isinstance(layer, kind):
                    (kernel, _), (stride, _) = layer.kernel_size, layer.stride
                    return kind(layer.in_channels, layer.out_channels, kernel, stride)
            return layer

        assert agent.encoder is not None
        assert agent.decoder is not None
        posterior = next(m for m in agent.encoder.modules() if hasattr(m, "convolutions"))
        self.convolutions = nn.Sequential(*map(as_is, posterior.convolutions))
        self.head = nn.Linear(256, 2 * agent.encoder.latent_dim)
        self.decoder = nn.Sequential(*map(as_is, agent.decoder.network))

    def loss(self, pixels: Tensor) -> Tensor:
        """Equation (1) of images ``[B, C, 64, 64]``, uint8."""
        images = pixels.float() / 255.0
        loc, log_scale = self.head(self.convolutions(images)).chunk(2, -1)
        scale = log_scale.exp()
        made = self.decoder(loc + scale * torch.randn_like(loc))
        divergence = 0.5 * (loc.square() + scale.square() - 2 * log_scale - 1).mean()
        return (made - images).square().mean() + 1e-6 * divergence
