"""Augmentation of the VAE's images: shifts and perspectives that enlarge a dataset (section 1.3.4)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


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
