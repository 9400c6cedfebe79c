"""Colours and fonts that all pictures share. Importing it lets matplotlib draw without a screen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from torch import Tensor

from ls3_recipes.console import console

INK, SAFE, UNSAFE, PALE, GOAL = "#22303c", "#1b7f79", "#d1495b", "#b8c4cc", "#e0a458"
STYLE: Any = {
    "figure.dpi": 130,
    "savefig.bbox": "tight",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.edgecolor": PALE,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
}


#: What draws pictures, by the names of their files.
Pictures = dict[str, Callable[[], None]]


def draw(pictures: Pictures, after_each: Callable[[], object] = lambda: None) -> dict[str, str]:
    """Draw pictures one by one; one that fails costs nothing but itself, and is told.

    Args:
        pictures: what draws them, by the names of their files.
        after_each: called after each.

    Returns:
        The reasons why pictures failed, by the same names.
    """
    failed = {}
    for name, plot in pictures.items():
        try:
            plot()
        except Exception as error:  # whatever it is: the results are there already
            failed[name] = f"{type(error).__name__}: {' '.join(str(error).split())}"
            console.print(f"{name} was not drawn: {failed[name]}", markup=False)
        after_each()
    return failed


class Label(NamedTuple):
    """How pictures of several runs show an algorithm: the name that people know it by, and the colour of its curves."""

    title: str
    colour: str


@contextmanager
def picture(path: Path, rows: int, columns: int, size: tuple[float, float], **options: Any) -> Iterator[tuple]:
    """A figure with a grid of axes ``[rows, columns]``, saved when the block is left."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, **options)
        try:
            yield figure, axes
            figure.savefig(path)
        finally:
            plt.close(figure)


def grid(axis: Axes) -> None:
    """Pale lines behind a curve."""
    axis.grid(color=PALE, alpha=0.4, lw=0.6)


def line(track: Tensor) -> np.ndarray:
    """Positions ``[T, 2]`` as the x and y that matplotlib draws."""
    return track.detach().cpu().numpy().T


def image(pixels: Tensor) -> np.ndarray:
    """The newest picture of an observation ``[C, S, S]``, as matplotlib shows it."""
    return pixels[-3:].permute(1, 2, 0).cpu().numpy()
