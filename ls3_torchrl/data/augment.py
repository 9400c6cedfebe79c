"""Augmentation of the VAE's images: random resized crops, and shifts and perspectives that enlarge a dataset."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample


def random_resized_crop(
    pixels: Tensor, *, scale: tuple[float, float] = (0.8, 1.0), generator: torch.Generator | None = None
) -> Tensor:
    """Crop a random part of each image and stretch it back to full size.

    Args:
        pixels: ``[B, C, H, W]``, uint8 or floats in [0, 1].
        scale: range of the fraction of the image's area that the crop covers, within (0, 1].
        generator: source of randomness.

    Returns:
        float32 ``[B, C, H, W]`` in [0, 1].

    Raises:
        ValueError: for a scale outside (0, 1] or in the wrong order.

    Example:
        >>> random_resized_crop(torch.zeros(2, 3, 64, 64, dtype=torch.uint8)).shape
        torch.Size([2, 3, 64, 64])
    """
    return resized_crop(pixels, random_crops(len(pixels), scale=scale, generator=generator))


def random_crops(
    count: int, *, scale: tuple[float, float] = (0.8, 1.0), generator: torch.Generator | None = None
) -> Tensor:
    """Squares within an image whose sides reach from -1 to 1: half the side of each and its middle, ``[count, 3]``.

    Args:
        count: how many.
        scale: range of the fraction of the image's area that a square covers, within (0, 1].
        generator: source of randomness.

    Raises:
        ValueError: for a scale outside (0, 1] or in the wrong order.
    """
    low, high = scale
    if not 0 < low <= high <= 1:
        raise ValueError(f"scale must satisfy 0 < low <= high <= 1, got {scale}.")
    draws = torch.rand(3, count, generator=generator)
    side = (low + (high - low) * draws[0]).sqrt()
    return torch.cat([side.unsqueeze(0), (1 - side) * (2 * draws[1:] - 1)]).T


def resized_crop(pixels: Tensor, crops: Tensor) -> Tensor:
    """The part of each image that :func:`random_crops` gives, stretched to full size.

    Args:
        pixels: ``[B, C, H, W]``, uint8 or floats in [0, 1].
        crops: ``[B, 3]``.

    Returns:
        float32 ``[B, C, H, W]`` in [0, 1].
    """
    images = pixels.float() / 255.0 if pixels.dtype == torch.uint8 else pixels.float()
    crops = crops.to(images.device)
    theta = torch.zeros(len(images), 2, 3, device=images.device)
    # affine_grid maps the output square [-1, 1]² to the crop: side · x + middle.
    theta[:, 0, 0] = theta[:, 1, 1] = crops[:, 0]
    theta[:, :, 2] = crops[:, 1:]
    grid = affine_grid(theta, list(images.shape), align_corners=False)
    return grid_sample(images, grid, mode="bilinear", padding_mode="border", align_corners=False)


def random_perspective(
    pixels: Tensor, *, shift: float = 0.08, tilt: float = 0.06, generator: torch.Generator | None = None
) -> Tensor:
    """Move each image by a random affine translation and tilt it in perspective (section 1.3.4).

    What comes into view repeats the pixels of the nearest edge.

    Args:
        pixels: uint8 ``[B, C, H, W]``.
        shift: largest translation along each axis, a fraction of the image's side within [0, 0.5].
        tilt: largest displacement of each corner beyond it, a fraction of the side within [0, 0.25].
        generator: source of randomness.

    Returns:
        uint8 ``[B, C, H, W]``.

    Raises:
        TypeError: for images that are not uint8.
        ValueError: for a shift or tilt out of range.
        ImportError: without OpenCV, which nothing else here needs.

    Example:
        >>> random_perspective(torch.zeros(2, 3, 64, 64, dtype=torch.uint8)).shape
        torch.Size([2, 3, 64, 64])
    """
    if pixels.dtype != torch.uint8:
        raise TypeError(f"random_perspective needs uint8 images, got {pixels.dtype}.")
    if not (0.0 <= shift <= 0.5 and 0.0 <= tilt <= 0.25):
        raise ValueError(f"shift must lie in [0, 0.5] and tilt in [0, 0.25], got {shift} and {tilt}.")
    import numpy as np

    cv2 = _opencv()
    height, width = pixels.shape[-2:]
    side = np.array([width, height], dtype=np.float32)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32) * (side - 1)
    draws = 2 * torch.rand(len(pixels), 5, 2, generator=generator).numpy() - 1
    moved = corners + side * (shift * draws[:, :1] + tilt * draws[:, 1:])
    images = pixels.movedim(1, -1).cpu().numpy()
    out = [
        # OpenCV drops the last dimension of grey images.
        cv2.warpPerspective(
            image,
            cv2.getPerspectiveTransform(corners, target.astype(np.float32)),
            (width, height),
            borderMode=cv2.BORDER_REPLICATE,
        ).reshape(image.shape)
        for image, target in zip(images, moved, strict=True)
    ]
    return torch.from_numpy(np.stack(out)).movedim(-1, 1).contiguous().to(pixels.device)


def _opencv() -> Any:
    """OpenCV, imported where it is used: it is large, and not everywhere its libraries are."""
    try:
        import cv2
    except ImportError as error:
        raise ImportError(
            f"random_perspective needs OpenCV, which cannot be imported ({error}). Install it with "
            "pip install 'ls3-torchrl[recipes]' or pip install opencv-python-headless."
        ) from error
    return cv2
