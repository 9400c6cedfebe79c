"""Films of episodes: mp4 for browsers and slides, GIF for everything else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
from PIL import Image, ImageDraw
from tensordict import TensorDictBase

from ls3_recipes.plots.style import PALE, SAFE, UNSAFE, image

#: Frames a second.
RATE = 16


def frames_of(episodes: TensorDictBase, *, count: int = 6, zoom: int = 3, gap: int = 6) -> list[Image.Image]:
    """Some episodes side by side, each framed green in the goal and red where it violates.

    Args:
        episodes: ``[N, T]`` with ``pixels``.
        count: how many of them.
        zoom: pixels for each of an image's.
        gap: between the episodes.
    """
    frames = []
    shown = episodes[:count]
    observations = shown["next", "pixels"]
    side = observations.shape[-1] * zoom
    for t in range(observations.shape[1]):
        sheet = Image.new("RGB", (len(shown) * (side + gap) + gap, side + 2 * gap), "white")
        pen = ImageDraw.Draw(sheet)
        for i in range(len(shown)):
            x = gap + i * (side + gap)
            bad, good = (bool(shown["next", key][i, t]) for key in ("constraint", "success"))
            colour = UNSAFE if bad else SAFE if good else PALE
            pen.rectangle((x - 3, gap - 3, x + side + 2, gap + side + 2), fill=colour)
            frame = Image.fromarray(image(observations[i, t]))
            sheet.paste(frame.resize((side, side), Image.Resampling.NEAREST), (x, gap))
        frames.append(sheet)
    return frames


def save_film(path: Path, episodes: TensorDictBase, *, count: int = 6) -> None:
    """A film of some episodes side by side.

    Args:
        path: ``.mp4`` for H.264, or ``.gif``.
        episodes: ``[N, T]`` with ``pixels``.
        count: how many of them.
    """
    frames = frames_of(episodes, count=count)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".gif":
        first, *others = [frame.quantize(32) for frame in frames]
        first.save(path, save_all=True, append_images=others, duration=1000 // RATE, loop=0, optimize=True)
    else:
        _save_mp4(path, frames)


def _save_mp4(path: Path, frames: Sequence[Image.Image]) -> None:
    width, height = frames[0].size
    with av.open(str(path), "w") as film:
        stream = film.add_stream("h264", rate=RATE, options={"crf": "23", "preset": "slow"})
        stream.width, stream.height, stream.pix_fmt = width + width % 2, height + height % 2, "yuv420p"
        stream.thread_count = 1
        for frame in frames:
            padded = Image.new("RGB", (stream.width, stream.height), "white")
            padded.paste(frame)
            film.mux(stream.encode(av.VideoFrame.from_ndarray(np.asarray(padded), format="rgb24")))
        film.mux(stream.encode(None))
