"""Images of any size as the encoder takes them."""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ls3_torchrl._checks import require_choice
from ls3_torchrl.data.packages import require_package

#: How an image of another shape becomes a square one.
Fit: TypeAlias = Literal["squash", "crop"]
#: Where images have their channels.
Channels: TypeAlias = Literal["last", "first"]


def pixels_from_images(
    images: Any, *, size: int | tuple[int, int] = 64, fit: Fit = "squash", channels: Channels = "last"
) -> Tensor:
    """Images of a camera or a file as the encoder takes them: uint8, channels first, of one size.

    What recorded data go through in :func:`~ls3_torchrl.data.episode_from_images`,
    :func:`~ls3_torchrl.data.load_minari` and :func:`~ls3_torchrl.data.load_lerobot`; an agent that acts must see its
    images in the same way.

    Args:
        images: uint8 in 0..255, arrays or tensors: one image ``[H, W, C]`` or ``[H, W]``, or several behind one another
            ``[N, H, W, C]``; C is 1 (grey, which becomes three equal channels) or 3 for each stacked frame.
        size: height and width of what returns, one number where they are alike.
        fit: ``"squash"`` keeps all that the camera saw and changes its proportions; ``"crop"`` keeps the proportions
            and cuts off at both sides what is too much, so that hazards there are seen no more.
        channels: ``"first"`` for images ``[C, H, W]`` and ``[N, C, H, W]``.

    Returns:
        uint8 ``[C, height, width]`` or ``[N, C, height, width]``; images that have the size already stay bit by bit
        as they are, others are resized by Pillow, bilinear with antialiasing.

    Raises:
        ModuleNotFoundError: when images must be resized and Pillow is not installed.
        TypeError: for images that are not uint8.
        ValueError: for another shape.

    Example:
        >>> pixels_from_images(np.zeros((480, 640, 3), dtype=np.uint8)).shape
        torch.Size([3, 64, 64])
        >>> video = torch.zeros(5, 3, 48, 64, dtype=torch.uint8)
        >>> pixels_from_images(video, size=(32, 64), fit="crop", channels="first").shape
        torch.Size([5, 3, 32, 64])
    """
    shape = require_image_settings(size, fit, channels)
    array = np.asarray(images.cpu() if isinstance(images, Tensor) else images)
    if array.dtype != np.uint8:
        raise TypeError(
            f"Images must be uint8 in 0..255, got {array.dtype}. Give (255 * images).round().astype('uint8') where "
            "they lie in [0, 1]."
        )
    several = array.ndim == 4
    if array.ndim == 2:
        array = array[..., None] if channels == "last" else array[None]
    if array.ndim not in (3, 4) or 0 in array.shape:
        raise ValueError(
            f"Images must have shape [H, W], [H, W, C] or [N, H, W, C], got {list(array.shape)}. Give one a step."
        )
    batch = array if several else array[None]
    batch = np.moveaxis(batch, -3, -1) if channels == "first" else batch
    _require_channels(batch.shape[1:], channels)
    resized = [_resized(image, shape, fit) for image in batch]
    out = torch.from_numpy(np.stack(resized)).movedim(-1, 1).contiguous()
    out = out.repeat_interleave(3, 1) if out.shape[1] == 1 else out
    return out if several else out[0]


def require_image_settings(size: int | tuple[int, int], fit: str, channels: str = "last") -> tuple[int, int]:
    """Check what :func:`pixels_from_images` takes beside images.

    Returns:
        Height and width.

    Raises:
        ValueError: for a size that is not one or two positive whole numbers, or unknown words.
    """
    require_choice(channels, ("last", "first"), "channels")
    require_choice(fit, ("squash", "crop"), "fit")
    sides = tuple(size) if isinstance(size, (tuple, list)) else (size, size)
    if len(sides) != 2 or any(not isinstance(side, int) or isinstance(side, bool) or side < 1 for side in sides):
        raise ValueError(f"size must be a positive whole number, or height and width as two of them; got {size!r}.")
    return sides


def _require_channels(shape: tuple[int, ...], channels: Channels) -> None:
    height, width, count = shape
    other_end = height if channels == "last" else width  # where the channels would be if they came there
    swapped = (other_end == 1 or other_end % 3 == 0) and other_end < count
    if (count == 1 or count % 3 == 0) and not (swapped and count > 3):
        return
    other = "last" if channels == "first" else "first"
    remedy = (
        f"Their channels seem to come {other}: give channels={other!r}."
        if swapped
        else "Give one channel, or three for each frame, for example images[..., :3] without transparency."
    )
    given = [count, height, width] if channels == "first" else list(shape)
    raise ValueError(f"Images with channels {channels} must have 1 channel, or 3 for each frame, got {given}. {remedy}")


def _resized(image: np.ndarray, shape: tuple[int, int], fit: Fit) -> np.ndarray:
    """An image ``[H, W, C]`` in another size."""
    if image.shape[:2] == shape:
        return image
    pillow = require_package("PIL.Image", "Resizing images", "pillow")
    box = _crop_box(image.shape[0], image.shape[1], shape) if fit == "crop" else None
    frames = np.split(image, range(3, image.shape[-1], 3), axis=-1)
    parts = []
    for frame in frames:
        whole = pillow.fromarray(np.ascontiguousarray(frame[..., 0] if frame.shape[-1] == 1 else frame))
        small = whole.resize(shape[::-1], pillow.Resampling.BILINEAR, box=box)
        parts.append(np.asarray(small).reshape(*shape, frame.shape[-1]))
    return np.concatenate(parts, axis=-1)


def _crop_box(height: int, width: int, shape: tuple[int, int]) -> tuple[float, float, float, float]:
    """The largest box of the wanted proportions in the middle: left, upper, right, lower."""
    scale = min(height / shape[0], width / shape[1])
    kept_height, kept_width = shape[0] * scale, shape[1] * scale
    left, upper = (width - kept_width) / 2, (height - kept_height) / 2
    return left, upper, left + kept_width, upper + kept_height
