"""The β-VAE's two halves, f_enc and f_dec (supplement, section 1.1.1)."""

from __future__ import annotations

import math

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from torch import Tensor, nn
from torch.distributions import Normal
from torchrl.modules import NormalParamExtractor

from ls3_torchrl._checks import require_at_least, require_finite, require_keys, require_positive
from ls3_torchrl.modules.convolutions import FastConv2d, FastConvTranspose2d
from ls3_torchrl.modules.relu import FastReLU

IMAGE_SIZE = 64
_FEATURES = 256
_INITIAL_LOG_SCALE = -3.0


def as_unit_pixels(pixels: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """Images of any size as floats in [0, 1].

    Args:
        pixels: ``[*B, C, H, W]``, uint8 in 0…255, or floating point already in [0, 1].
        dtype: of the floats.

    Raises:
        ValueError: for floats that are not finite.
        TypeError: for another dtype.
    """
    if pixels.ndim == 4:  # the convolutions' own order of memory, taken on while the images are small
        pixels = pixels.contiguous(memory_format=torch.channels_last)
    if pixels.dtype == torch.uint8:
        return pixels.to(dtype).div_(255.0)
    if pixels.is_floating_point():
        require_finite(pixels, "The image batch")
        return pixels.to(dtype)
    raise TypeError(f"Pixels must be uint8 in 0..255 or floating point in [0, 1], got {pixels.dtype}.")


def _require_unit_range(pixels: Tensor) -> None:
    if torch.compiler.is_compiling() or not pixels.numel():
        return
    low, high = (float(end) for end in pixels.detach().aminmax())
    if low >= -0.01 and high <= 1.01:  # what interpolation may overshoot by
        return
    raise ValueError(
        f"Images of {pixels.dtype} must lie in [0, 1]; received values from {low:.4g} to {high:.4g}. Give uint8 "
        "images, or divide by 255."
    )


class _ConvolutionalPosterior(nn.Module):
    """Images to the mean and standard deviation of q(z|s)."""

    def __init__(self, in_channels: int, latent_dim: int, min_scale: float) -> None:
        super().__init__()
        self.in_channels = in_channels
        # Hafner et al.'s encoder with stride 3 in the second layer: 64 -> 31 -> 10 -> 4 -> 1.
        self.convolutions = nn.Sequential(
            nn.Conv2d(in_channels, 32, 4, stride=2),
            FastReLU(),
            nn.Conv2d(32, 64, 4, stride=3),
            FastReLU(),
            FastConv2d(64, 128, 4, stride=2),
            FastReLU(),
            FastConv2d(128, _FEATURES, 4, stride=2),
            FastReLU(),
            nn.Flatten(),
        )
        self.head = nn.Linear(_FEATURES, 2 * latent_dim)
        # A posterior that starts narrow: noise of scale 1 would drown the small means of an untrained encoder,
        # and the decoder would dwell on the mean image.
        nn.init.constant_(self.head.bias[latent_dim:], _INITIAL_LOG_SCALE)
        self.to_params = NormalParamExtractor(scale_mapping="exp", scale_lb=min_scale)

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        if pixels.ndim < 3 or tuple(pixels.shape[-3:]) != (self.in_channels, IMAGE_SIZE, IMAGE_SIZE):
            raise ValueError(
                f"Pixels must have shape [*B, {self.in_channels}, {IMAGE_SIZE}, {IMAGE_SIZE}] (channels first), "
                f"got {list(pixels.shape)}. Resize or permute the images, or build the encoder with in_channels "
                "= 3 x stacked frames."
            )
        dtype = computed = self.head.weight.dtype
        # The first convolution would round them to autocast's dtype; to divide in it gives the same.
        if pixels.device.type == "cpu" and pixels.dtype == torch.uint8 and torch.is_autocast_enabled("cpu"):
            computed = torch.get_autocast_dtype("cpu")
        images = as_unit_pixels(pixels, computed)
        if pixels.is_floating_point():
            _require_unit_range(pixels)
        batch = images.shape[:-3]
        images = images.reshape(-1, *images.shape[-3:]).contiguous(memory_format=torch.channels_last)
        # Not in the lower precision of autocast: it cannot tell means that are close together.
        loc, scale = self.to_params(self.head(self.convolutions(images)).to(dtype))
        return loc.reshape(*batch, -1), scale.reshape(*batch, -1)


class PixelEncoder(ProbabilisticTensorDictSequential):
    """f_enc: images to a diagonal Gaussian over latents, q(z|s) = N(loc, scale²) (equation (1)).

    Convolutions of 32, 64, 128 and 256 channels (kernel 4, strides 2, 3, 2, 2), then one linear layer.
    The written latent follows tensordict's interaction type: the mean by default, a reparameterised sample
    under ``set_interaction_type(InteractionType.RANDOM)``. ``get_dist(td)`` gives the distribution.

    Args:
        in_channels: C, 3 × stacked frames.
        latent_dim: D, size of the latent (Table 1: 32).
        min_scale: lower bound of the posterior's standard deviation.
        pixels_key: where images ``[*B, C, 64, 64]`` are read, uint8 or floats in [0, 1].
        loc_key: where the mean ``[*B, D]`` is written.
        scale_key: where the standard deviation ``[*B, D]`` is written.
        latent_key: where the latent ``[*B, D]`` is written.

    Raises:
        ValueError: for a wrong image shape, or images that are not finite or, as floats, not in [0, 1].
        TypeError: for a dtype other than uint8 and floating point.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> encoder = PixelEncoder(latent_dim=8)
        >>> td = TensorDict({"pixels": torch.zeros(5, 3, 64, 64, dtype=torch.uint8)}, [5])
        >>> encoder(td)["latent"].shape
        torch.Size([5, 8])
    """

    def __init__(
        self,
        in_channels: int = 3,
        latent_dim: int = 32,
        *,
        min_scale: float = 1e-4,
        pixels_key: NestedKey = "pixels",
        loc_key: NestedKey = "loc",
        scale_key: NestedKey = "scale",
        latent_key: NestedKey = "latent",
    ) -> None:
        require_at_least(in_channels, 1, "in_channels")
        require_at_least(latent_dim, 1, "latent_dim")
        posterior = TensorDictModule(
            _ConvolutionalPosterior(in_channels, latent_dim, min_scale),
            in_keys=[pixels_key],
            out_keys=[loc_key, scale_key],
        )
        sample = ProbabilisticTensorDictModule(
            in_keys={"loc": loc_key, "scale": scale_key},
            out_keys=[latent_key],
            distribution_class=Normal,
            default_interaction_type=InteractionType.DETERMINISTIC,
        )
        super().__init__(posterior, sample)
        self.in_channels = in_channels
        self.latent_dim = latent_dim
        self.pixels_key, self.latent_key = pixels_key, latent_key
        self.loc_key, self.scale_key = loc_key, scale_key

    def of_pixels(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation ``[*B, D]`` of the latents of images ``[*B, C, 64, 64]``."""
        return self[0].module(pixels)

    @torch.no_grad()
    def rescale(self, factor: float) -> None:
        """Measure latents in another unit: means and standard deviations become ``factor`` times what they were.

        With :meth:`PixelDecoder.rescale` by the same factor every reconstruction stays as it is.

        Args:
            factor: above 0.
        """
        require_positive(factor, "factor")
        head = self[0].module.head
        head.weight[: self.latent_dim] *= factor
        head.bias[: self.latent_dim] *= factor
        head.bias[self.latent_dim :] += math.log(factor)


class PixelDecoder(TensorDictModuleBase):
    """f_dec: latents back to images (equation (1)).

    Linear to 256, then transposed convolutions of 128, 64, 32 and C channels (kernels 5, 5, 6, 6, stride 2).
    The output is not clamped: a clamp inside the loss would stop the gradient of every pixel that starts
    below zero. Clamp to [0, 1] for viewing.

    Args:
        out_channels: C, 3 × stacked frames.
        latent_dim: D.
        background: add the network's output to a fixed image, ``background`` ``[C, 64, 64]``, black until
            :meth:`set_background` is called. With the mean image, the network need not learn it before it sees what
            moves. The paper has none.
        latent_key: where latents ``[*B, D]`` are read.
        reco_key: where images ``[*B, C, 64, 64]`` in about [0, 1] are written, in the latents' dtype.

    Raises:
        KeyError: when the latent is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> decoder = PixelDecoder(latent_dim=8)
        >>> decoder(TensorDict({"latent": torch.zeros(5, 8)}, [5]))["reco_pixels"].shape
        torch.Size([5, 3, 64, 64])
    """

    def __init__(
        self,
        out_channels: int = 3,
        latent_dim: int = 32,
        *,
        background: bool = False,
        latent_key: NestedKey = "latent",
        reco_key: NestedKey = "reco_pixels",
    ) -> None:
        super().__init__()
        self.in_keys = [latent_key]
        self.out_keys = [reco_key]
        self.network = nn.Sequential(
            nn.Linear(latent_dim, _FEATURES),
            nn.Unflatten(-1, (_FEATURES, 1, 1)),
            FastConvTranspose2d(_FEATURES, 128, 5, stride=2),
            FastReLU(),
            FastConvTranspose2d(128, 64, 5, stride=2),
            FastReLU(),
            FastConvTranspose2d(64, 32, 6, stride=2),
            FastReLU(),
            FastConvTranspose2d(32, out_channels, 6, stride=2),
        )
        self.background: Tensor | None
        self.register_buffer("background", torch.zeros(out_channels, IMAGE_SIZE, IMAGE_SIZE) if background else None)

    @torch.no_grad()
    def set_background(self, image: Tensor) -> None:
        """Add the network's output to an image from now on.

        Args:
            image: ``[C, 64, 64]``, floats in [0, 1], such as the mean of all images.

        Raises:
            RuntimeError: for a decoder without a background.
        """
        if self.background is None:
            raise RuntimeError("This decoder has no background. Build it with background=True.")
        self.background.copy_(image)

    @torch.no_grad()
    def rescale(self, factor: float) -> None:
        """Read latents that are ``factor`` times what they were; see :meth:`PixelEncoder.rescale`."""
        require_positive(factor, "factor")
        first = self.network[0]
        assert isinstance(first, nn.Linear)
        first.weight /= factor

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the reconstruction of the latent."""
        require_keys(tensordict, self.in_keys, "PixelDecoder")
        return tensordict.set(self.out_keys[0], self.of_latent(tensordict.get(self.in_keys[0])))

    def of_latent(self, latent: Tensor) -> Tensor:
        """Images ``[*B, C, 64, 64]`` of latents ``[*B, D]``."""
        images = self.network(latent.reshape(-1, latent.shape[-1])).to(latent.dtype)
        if self.background is not None:
            images = images + self.background
        return images.reshape(*latent.shape[:-1], *images.shape[-3:])
