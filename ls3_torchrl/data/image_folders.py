"""Episodes from image files."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from ls3_torchrl.data.episodes import episode_from_arrays
from ls3_torchrl.data.keys import EpisodeKeys
from ls3_torchrl.data.packages import require_package
from ls3_torchrl.data.pixels import Fit, pixels_from_images, require_image_settings

#: Endings of the files of a folder that are images.
SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
#: Pillow's names of what has 8 bits for each channel, or a palette of such.
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr", "HSV", "LAB")


def episode_from_images(
    images: str | Path | Iterable[str | Path],
    actions: Any,
    rewards: Any,
    constraints: Any,
    successes: Any,
    *,
    size: int | tuple[int, int] = 64,
    fit: Fit = "squash",
    keys: EpisodeKeys | None = None,
) -> TensorDict:
    """An episode of T steps from T + 1 image files and arrays, ready for the buffer.

    Args:
        images: a folder of image files, one for each observation, the one after the last step included. They are taken
            in the natural order of their names: ``img_2.png`` comes before ``img_10.png``. Other files and hidden ones
            are left out. Or a list of files, which are taken in its order.
        actions: ``[T, A]``.
        rewards: ``[T]`` or ``[T, 1]``: −1 outside of the goal, 0 in it.
        constraints: whether each step's next state violates a constraint, ``[T]`` or ``[T, 1]``, bools or 0 and 1.
        successes: whether it lies in the goal set, alike.
        size: height and width of the episode's images, one number where they are alike.
        fit: ``"squash"`` keeps all that the camera saw, ``"crop"`` keeps the proportions: see
            :func:`~ls3_torchrl.data.pixels_from_images`.
        keys: under which keys they go; the defaults of :class:`~ls3_torchrl.data.EpisodeKeys` when ``None``.

    Returns:
        ``[T]``, with images uint8 ``[T, 3, height, width]``: red, green and blue. Grey images get three equal channels,
        transparency is left out, and images are turned upright where the camera noted how it was held.

    Raises:
        ModuleNotFoundError: when Pillow is not installed.
        FileNotFoundError: for a folder or file that does not exist, or a folder without images.
        ValueError: when the number of images is not that of actions plus one, when images differ in size, for a file
            that is no image, or one of more than 8 bits for each channel; and as
            :func:`~ls3_torchrl.data.episode_from_arrays` refuses the arrays.

    Example:
        >>> import tempfile, numpy as np
        >>> from PIL import Image
        >>> no = np.zeros(10)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for t in range(11):
        ...         Image.new("RGB", (640, 480), (20 * t, 0, 0)).save(f"{folder}/img_{t}.png")
        ...     episode = episode_from_images(folder, np.zeros((10, 2)), no - 1.0, no, no)
        >>> episode["pixels"].shape, episode["next", "pixels"][:, 0, 0, 0].tolist()
        (torch.Size([10, 3, 64, 64]), [20, 40, 60, 80, 100, 120, 140, 160, 180, 200])
    """
    require_image_settings(size, fit)
    files, where = _files(images)
    steps = len(actions)
    if len(files) != steps + 1:
        names = f" ({files[0].name} to {files[-1].name})" if files else ""
        raise ValueError(
            f"{where} has {len(files)} images{names} for {steps} actions; there must be {steps + 1}: one more than "
            "actions. Add the image after the last step, or leave out what belongs to no step."
        )
    observations = _read(files, size, fit)
    return episode_from_arrays(observations, actions, rewards, constraints, successes, keys=keys)


def natural_order(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """What to sort names by, so that numbers in them count as numbers.

    Example:
        >>> sorted(["img_10.png", "img_2.png", "img_1.png"], key=natural_order)
        ['img_1.png', 'img_2.png', 'img_10.png']
    """
    parts = re.split(r"([0-9]+)", name.casefold())
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts], name


def _files(images: str | Path | Iterable[str | Path]) -> tuple[list[Path], str]:
    """The files in their order, and how to call them."""
    if not isinstance(images, (str, Path)):
        return [Path(file) for file in images], "The list of images"
    folder = Path(images)
    if not folder.is_dir():
        kind = "is a file" if folder.exists() else "does not exist"
        raise FileNotFoundError(f"{folder} {kind}. Give a folder of images, or a list of files.")
    there = [path for path in folder.iterdir() if not path.name.startswith(".")]
    files = [path for path in there if path.suffix.lower() in SUFFIXES and path.is_file()]
    if not files:
        inner = sorted((path.name for path in there if path.is_dir()), key=natural_order)
        remedy = f"It has the folders {inner[:3]}: give one of them, for one episode." if inner else "Give another one."
        raise FileNotFoundError(f"{folder} holds no image: none of {', '.join(SUFFIXES)}. {remedy}")
    return sorted(files, key=lambda path: natural_order(path.name)), str(folder)


def _read(files: list[Path], size: int | tuple[int, int], fit: Fit) -> Tensor:
    """All images in one size, ``[T + 1, 3, height, width]``; only one is held in its own."""
    pillow = require_package("PIL.Image", "episode_from_images", "pillow")
    out, first = [], None
    for file in files:
        image = _open(file, pillow)
        first = first or image.size
        if image.size != first:
            raise ValueError(
                f"{file} has {image.size[0]} x {image.size[1]} pixels, where {files[0].name} has {first[0]} x "
                f"{first[1]}. Images of an episode come from one camera: resize them, or leave out what is none of it."
            )
        out.append(pixels_from_images(image, size=size, fit=fit))
    return torch.stack(out)


def _open(file: Path, pillow: Any) -> Any:
    """An image in RGB, upright."""
    operations = require_package("PIL.ImageOps", "episode_from_images", "pillow")
    if not file.is_file():
        raise FileNotFoundError(f"{file} is no file. Give files of images.")
    try:
        with pillow.open(file) as image:
            if image.mode not in _MODES:
                raise ValueError(
                    f"{file} has pixels of kind {image.mode!r}, such as 16 bits for each, which do not tell what is "
                    "white. Convert it to 8 bits first, or give arrays to episode_from_arrays()."
                )
            return operations.exif_transpose(image).convert("RGB")
    except (OSError, SyntaxError) as error:
        raise ValueError(f"{file} cannot be read as an image ({error}). Use another copy, or leave it out.") from error
