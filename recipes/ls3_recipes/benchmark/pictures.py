"""The benchmark's pictures: cost as work grows, and where the time of whole runs goes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from ls3_recipes.plots.style import GOAL, INK, PALE, SAFE, UNSAFE, grid, picture

_COLOURS = (SAFE, GOAL, UNSAFE, "#4f6d9c", "#8a5a83", "#7a9e3f", "#c58c6d", "#5fa8b8", PALE)


def plot_growth(path: Path, curves: Sequence[dict[str, Any]], preset: str) -> None:
    """A panel for each curve: medians with their spread, the power that fits best, and what proportion would be."""
    columns = min(len(curves), 4)
    rows = -(-len(curves) // columns)
    size = (2.6 * columns + 0.4, 2.5 * rows + 0.5)
    with picture(path, rows, columns, size, constrained_layout=True) as (figure, axes):
        figure.suptitle(f"Cost as work grows, preset {preset}")
        for axis, curve in zip(axes.flat, curves, strict=False):
            _plot_curve(axis, curve)
        for axis in axes.flat[len(curves) :]:
            axis.set_axis_off()
        for line in axes:
            line[0].set_ylabel("ms")
        axes.flat[0].legend(fontsize=7, loc="upper left", handlelength=1.6)


def _plot_curve(axis: Axes, curve: dict[str, Any]) -> None:
    sizes, costs = np.array(curve["sizes"]), np.array(curve["median_ms"])
    slope = curve["exponent"]
    level = np.exp(np.log(costs).mean() - slope * np.log(sizes).mean())
    axis.plot(sizes, costs[0] * sizes / sizes[0], ls=":", lw=1, color=PALE, label="in proportion")
    axis.plot(sizes, level * sizes**slope, lw=1.2, color=GOAL, label="fit")
    half = np.array(curve["iqr_ms"]) / 2
    axis.errorbar(sizes, costs, half, fmt="o", ms=4, lw=1, capsize=2, color=SAFE, label="measured")
    axis.set(xscale="log", yscale="log", xlabel=curve["unit"])
    axis.set_title(f"{curve['what']}: exponent {slope:.2f}")
    axis.xaxis.set_major_locator(FixedLocator(curve["sizes"]))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.yaxis.set_minor_formatter(NullFormatter())
    for ticks in (axis.xaxis, axis.yaxis):
        ticks.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    grid(axis)


def plot_runs(path: Path, runs: Sequence[dict[str, Any]]) -> None:
    """A bar for each run, stacked by phase; within it, filled as high as the cores were busy."""
    with picture(path, len(runs), 1, (8.5, 1.9 * len(runs) + 0.6), constrained_layout=True) as (figure, axes):
        figure.suptitle("Where the time of a whole run goes: width is time, filled height the share of the cores used")
        for axis, run in zip(axes.flat, runs, strict=True):
            _plot_run(axis, run)


def _plot_run(axis: Axes, run: dict[str, Any]) -> None:
    unit, name = (60.0, "minutes") if run["seconds"] >= 120.0 else (1.0, "seconds")
    start = 0.0
    for phase, colour in zip(run["phases"], _COLOURS, strict=False):
        width, used = phase["seconds"] / unit, phase.get("utilisation")
        share = phase["seconds"] / run["seconds"]
        told = f"{phase['name']} {share:.0%}"
        told += "" if used is None else f", cores {used:.0%}"
        axis.bar(start, 1.0, width, align="edge", color=colour, alpha=0.25, edgecolor="white", lw=0.6)
        axis.bar(start, used or 0.0, width, align="edge", color=colour, edgecolor="white", lw=0.6, label=told)
        if share > 0.08:
            axis.text(start + width / 2, 1.03, phase["name"], ha="center", va="bottom", fontsize=7.5, color=INK)
        start += width
    axis.set(xlim=(0.0, max(start, 1e-9)), ylim=(0.0, 1.16), xlabel=name)
    axis.set_yticks([0.0, 0.5, 1.0], ["0", "", f"{run['cores']} cores"])
    axis.set_title(f"{run['task']}, preset {run['preset']}: {run['seconds'] / unit:.1f} {name}", loc="left")
    axis.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
