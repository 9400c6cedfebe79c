"""Pictures of any run: learning curves, losses, paths over the plane, and a video."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from tensordict import TensorDictBase
from torch import Tensor

from ls3_envs import VisualConstraintEnv
from ls3_recipes.plots.films import save_film
from ls3_recipes.plots.plane import plane_of, plot_outlines, states_of, the_plane
from ls3_recipes.plots.style import INK, SAFE, UNSAFE, Pictures, grid, line, picture, plt
from ls3_recipes.run_files import read_metrics
from ls3_recipes.run_settings import TaskSettings
from ls3_torchrl.data import Tag

#: A metric by its phase and name: steps and values.
Series = dict[tuple[str, str], list[tuple[float, float]]]


def pictures_of_run(
    folder: Path,
    task: TaskSettings,
    offline: Mapping[Tag, TensorDictBase],
    tracks: Sequence[Tensor],
    evaluation: TensorDictBase,
) -> Pictures:
    """The pictures that a run of any algorithm leaves in its folder.

    Args:
        folder: the run's folder.
        task: what was learnt.
        offline: the demonstrations by tag; those without states are left out where paths are shown.
        tracks: states ``[N, T, S]`` of the online episodes, one entry an update.
        evaluation: the evaluation episodes ``[N, T]``.
    """
    pictures: Pictures = {
        "learning_curves.png": lambda: plot_learning_curves(folder, read_series(folder)),
        "losses.png": lambda: plot_losses(folder, read_series(folder)),
        "evaluation.gif": lambda: save_film(folder / "evaluation.gif", evaluation),
        "evaluation.mp4": lambda: save_film(folder / "evaluation.mp4", evaluation),
    }
    env = plane_of(task)
    if env is not None:
        pictures["paths.png"] = lambda: plot_paths(folder, env, offline, tracks, evaluation)
    return pictures


def read_series(folder: Path) -> Series:
    """The metrics of a run."""
    series: Series = {}
    for row in read_metrics(folder):
        series.setdefault((row["phase"], row["name"]), []).append((float(row["step"]), float(row["value"])))
    return series


def plot_learning_curves(folder: Path, series: Series) -> None:
    """Return, success and violations over online episodes."""
    titles = {"mean_return": "Mean return", "mean_success": "Success rate", "mean_violation": "Violation rate"}
    with picture(folder / "learning_curves.png", 1, 3, (11, 2.8)) as (_, axes):
        for axis, (name, title) in zip(axes[0], titles.items(), strict=True):
            points = series.get(("online", name), [])
            axis.plot(*zip(*points, strict=True) if points else ([], []), marker="o", ms=3.5, lw=1.6, color=SAFE)
            axis.set(title=title, xlabel="online episodes")
            if name != "mean_return":
                axis.set_ylim(-0.05, 1.05)
            grid(axis)


def plot_losses(folder: Path, series: Series) -> None:
    """The losses of every phase."""
    losses = {key: points for key, points in series.items() if key[1].startswith("loss_")}
    of_phase = Counter(phase for phase, _ in losses)
    height = max(-(-len(losses) // 4), 1)
    with picture(folder / "losses.png", height, 4, (12, 2.3 * height)) as (figure, axes):
        for axis in axes.flat[len(losses) :]:
            axis.axis("off")
        for axis, ((phase, name), points) in zip(axes.flat, losses.items(), strict=False):
            x, y = np.array(points).T
            axis.plot(x, y, lw=1.2, color=INK)
            if (y[np.isfinite(y)] > 0).all() and np.isfinite(y).any():
                axis.set_yscale("log")
            axis.set_title(phase if of_phase[phase] == 1 else f"{phase}: {name.removeprefix('loss_')}")
            grid(axis)
        figure.tight_layout()


def plot_paths(
    folder: Path,
    env: VisualConstraintEnv,
    offline: Mapping[Tag, TensorDictBase],
    tracks: Sequence[Tensor],
    evaluation: TensorDictBase,
) -> None:
    """Where the demonstrator went, where the agent went while it learnt, and where it goes now."""
    plane = the_plane(env)
    titles = ("Demonstrations", "Online episodes, first to last", "Evaluation")
    with picture(folder / "paths.png", 1, 3, (11, 3.2)) as (_, ((shown, learning, now),)):
        for axis, title in zip((shown, learning, now), titles, strict=True):
            plot_outlines(axis, plane)
            axis.set_title(title)
        tracks_shown = states_of(offline.get(Tag.SUCCESS), 20)
        if not tracks_shown:
            shown.set_title(f"{titles[0]} (without states)")
        for track in tracks_shown:
            shown.plot(*line(plane.positions(track)), color=SAFE, lw=0.6, alpha=0.6)
        colours = plt.get_cmap("viridis")(np.linspace(0.9, 0.1, max(len(tracks), 1)))
        for colour, update in zip(colours, tracks, strict=False):
            for track in update:
                learning.plot(*line(plane.positions(track)), color=colour, lw=0.7, alpha=0.7)
        violated = evaluation["next", "constraint"].any(1).flatten()
        for track, bad in zip(evaluation["state"], violated, strict=True):
            now.plot(*line(plane.positions(track)), color=UNSAFE if bad else SAFE, lw=0.8, alpha=0.7)
