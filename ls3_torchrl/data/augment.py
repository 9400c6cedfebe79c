"""Augmentation of the VAE's input images: random resized crops."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample


def random_resized_crop(
    pixels: Tensor, *, scale: tuple[float, float] = (0.8, 1.0), generator: torch.Generator | None = None
) -> Tensor:
    """Crop a random part of each image and stretch it back to full size.

    Args:
        pixels: ``[B, C, H, W]``, uint8 or floats in [0, 1].
        scale: range of the crop's share of the image's area, within (0, 1].
        generator: source of randomness.

    Returns:
        float32 ``[B, C, H, W]`` in [0, 1].

    Raises:
        ValueError: for a scale outside (0, 1] or in the wrong order.

    Example:
        >>> random_resized_crop(torch.zeros(2, 3, 64, 64, dtype=torch.uint8)).shape
        torch.Size([2, 3, 64, 64])
    """
    low, high = scale
    if not 0 < low <= high <= 1:
        raise ValueError(f"scale must satisfy 0 < low <= high <= 1, got {scale}.")
    images = pixels.float() / 255.0 if pixels.dtype == torch.uint8 else pixels.float()
    draws = torch.rand(3, len(images), generator=generator).to(images.device)
    side = (low + (high - low) * draws[0]).sqrt()
    # affine_grid maps the output square [-1, 1]² to the crop: side · x + shift.
    shift = (1 - side) * (2 * draws[1:] - 1)
    theta = torch.zeros(len(images), 2, 3, device=images.device)
    theta[:, 0, 0] = theta[:, 1, 1] = side
    theta[:, :, 2] = shift.T
    grid = affine_grid(theta, list(images.shape), align_corners=False)
    return grid_sample(images, grid, mode="bilinear", padding_mode="border", align_corners=False)
