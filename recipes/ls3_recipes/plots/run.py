"""Pictures of any run: curves, paths and maps over the plane, and a film."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from omegaconf import DictConfig
from PIL import Image, ImageDraw
from tensordict import TensorDictBase
from torch import Tensor

import ls3_envs
from common import read_metrics
from ls3_torchrl.data import Tag

INK, SAFE, UNSAFE, PALE = "#22303c", "#1b7f79", "#d1495b", "#b8c4cc"
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


def draw_run(
    folder: Path,
    config: DictConfig,
    offline: dict[Tag, TensorDictBase],
    tracks: list[Tensor],
    evaluation: TensorDictBase,
) -> None:
    """The pictures that a run of any algorithm leaves, into its folder.

    Args:
        folder: the run's folder.
        config: its configuration.
        offline: the demonstrations by tag.
        tracks: states ``[N, T, S]`` of the online episodes, one entry an update.
        evaluation: the evaluation episodes ``[N, T]``.
    """
    with plt.rc_context(STYLE), torch.no_grad():
        learning_curves(folder)
        video(folder / "evaluation.gif", evaluation)
        env = plane_of(config)
        if env is not None:
            paths(folder, env, offline, tracks, evaluation)


def plane_of(config: DictConfig) -> ls3_envs.VisualConstraintEnv | None:
    """The task's environment, where its states are a plane that maps can be drawn of."""
    env = ls3_envs.make(config.task.name, num_envs=1, seed=config.seed).base_env
    return None if env.plane() is None else env


def learning_curves(folder: Path) -> None:
    """Return, success and violations over online episodes, and the losses of every phase."""
    rows = read_metrics(folder)
    series: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for row in rows:
        series.setdefault((row["phase"], row["name"]), []).append((float(row["step"]), float(row["value"])))

    figure, axes = plt.subplots(1, 3, figsize=(11, 2.8))
    panels = (
        ("mean_return", "Mean return"),
        ("mean_success", "Success rate"),
        ("mean_violation", "Violation rate"),
    )
    for axis, (name, title) in zip(axes, panels, strict=True):
        points = series.get(("online", name), [])
        axis.plot(*zip(*points, strict=True) if points else ([], []), marker="o", ms=3.5, lw=1.6, color=SAFE)
        axis.set(title=title, xlabel="online episodes")
        if name != "mean_return":
            axis.set_ylim(-0.05, 1.05)
        axis.grid(color=PALE, alpha=0.4, lw=0.6)
    figure.savefig(folder / "learning_curves.png")
    plt.close(figure)

    losses = {key: points for key, points in series.items() if key[1].startswith("loss_")}
    of_phase = Counter(phase for phase, _ in losses)
    height = max(-(-len(losses) // 4), 1)
    figure, axes = plt.subplots(height, 4, figsize=(12, 2.3 * height), squeeze=False)
    for axis in axes.flat[len(losses) :]:
        axis.axis("off")
    for axis, ((phase, name), points) in zip(axes.flat, losses.items(), strict=False):
        x, y = np.array(points).T
        axis.plot(x, y, lw=1.2, color=INK)
        if (y > 0).all():
            axis.set_yscale("log")
        axis.set_title(phase if of_phase[phase] == 1 else f"{phase}: {name.removeprefix('loss_')}")
        axis.grid(color=PALE, alpha=0.4, lw=0.6)
    figure.tight_layout()
    figure.savefig(folder / "losses.png")
    plt.close(figure)


def line(track: Tensor) -> np.ndarray:
    """Positions ``[T, 2]`` as the x and y that matplotlib draws."""
    return track.detach().cpu().numpy().T


def wall(axis: Axes, extent: tuple[float, float, float, float]) -> None:
    """Wall, goal and frame of the navigation plane."""
    low, high = ls3_envs.navigation.WALL_LOW, ls3_envs.navigation.WALL_HIGH
    axis.add_patch(plt.Rectangle(low, high[0] - low[0], high[1] - low[1], fc="none", ec=INK, lw=1.2))
    axis.add_patch(plt.Circle(ls3_envs.navigation.GOAL, ls3_envs.navigation.GOAL_RADIUS, fc="none", ec=INK, lw=1.2))
    axis.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[], aspect="equal")


class Field(NamedTuple):
    """One map over the plane.

    Attributes:
        values: ``[n]``, one for each state of the plane.
        colours: name of a colour map.
        limits: of the colours; the values' own when ``None``.
        level: where a line is drawn.
    """

    values: Tensor
    colours: str
    limits: tuple[float, float] | None = None
    level: float | None = None


def over_plane(env: ls3_envs.VisualConstraintEnv, judge: Callable[[Tensor], TensorDictBase]) -> TensorDictBase:
    """What ``judge`` says of the images ``[n, C, S, S]`` of all states of the plane."""
    plane = env.plane()
    assert plane is not None
    states = plane[0].flatten(0, -2)
    return torch.cat([judge(env.render_states(part)) for part in states.split(512)])


def maps(
    folder: Path,
    env: ls3_envs.VisualConstraintEnv,
    fields: dict[str, Field],
    offline: dict[Tag, TensorDictBase],
) -> None:
    """Fields over the plane, demonstrations drawn in."""
    plane = env.plane()
    assert plane is not None
    grid, extent = plane[:2]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, len(fields), figsize=(3.2 * len(fields), 3.0), squeeze=False)
        for axis, (title, field) in zip(axes[0], fields.items(), strict=True):
            picture = field.values.reshape(grid.shape[:2]).cpu().numpy()
            low, high = field.limits or (picture.min(), picture.max())
            image = axis.imshow(
                picture, extent=extent, cmap=field.colours, vmin=low, vmax=high, interpolation="nearest"
            )
            if field.level is not None and picture.min() < field.level < picture.max():
                x, y = grid.unbind(-1)
                axis.contour(x.numpy(), y.numpy(), picture, levels=[field.level], colors=INK, linewidths=0.8)
            for tag, colour in ((Tag.SUCCESS, SAFE), (Tag.CONSTRAINT, UNSAFE)):
                if tag in offline:
                    for track in offline[tag]["state"][:8]:
                        axis.plot(*line(track), color=colour, lw=0.5, alpha=0.6)
            wall(axis, extent)
            axis.set_title(title)
            figure.colorbar(image, ax=axis, shrink=0.7, pad=0.02)
        figure.savefig(folder / "heatmaps.png")
        plt.close(figure)


def paths(
    folder: Path,
    env: ls3_envs.VisualConstraintEnv,
    offline: dict[Tag, TensorDictBase],
    tracks: list[Tensor],
    evaluation: TensorDictBase,
) -> None:
    """Where the teacher went, where the agent went while it learnt, and where it goes now."""
    plane = env.plane()
    assert plane is not None
    extent = plane[1]
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.2))
    titles = ("Demonstrations", "Online episodes, first to last", "Evaluation")
    for axis, title in zip(axes, titles, strict=True):
        wall(axis, extent)
        axis.set_title(title)
    for track in offline[Tag.SUCCESS]["state"][:20]:
        axes[0].plot(*line(track), color=SAFE, lw=0.6, alpha=0.6)
    colours = plt.get_cmap("viridis")(np.linspace(0.9, 0.1, max(len(tracks), 1)))
    for colour, update in zip(colours, tracks, strict=False):
        for track in update:
            axes[1].plot(*line(track), color=colour, lw=0.7, alpha=0.7)
    violated = evaluation["next", "constraint"].any(1).flatten()
    for track, bad in zip(evaluation["state"], violated, strict=True):
        axes[2].plot(*line(track), color=UNSAFE if bad else SAFE, lw=0.8, alpha=0.7)
    figure.savefig(folder / "paths.png")
    plt.close(figure)


def video(path: Path, episodes: TensorDictBase, *, count: int = 6, zoom: int = 3, gap: int = 6) -> None:
    """A GIF of some episodes side by side, each framed green in the goal and red once it violated."""
    frames = []
    shown = episodes[:count]
    images = shown["next", "pixels"][:, :, -3:]
    side = images.shape[-1] * zoom
    for t in range(images.shape[1]):
        sheet = Image.new("RGB", (count * (side + gap) + gap, side + 2 * gap), "white")
        pen = ImageDraw.Draw(sheet)
        for i in range(len(shown)):
            x = gap + i * (side + gap)
            bad, good = (bool(shown["next", key][i, t]) for key in ("constraint", "success"))
            colour = UNSAFE if bad else SAFE if good else PALE
            pen.rectangle((x - 3, gap - 3, x + side + 2, gap + side + 2), fill=colour)
            picture = Image.fromarray(images[i, t].permute(1, 2, 0).numpy())
            sheet.paste(picture.resize((side, side), Image.Resampling.NEAREST), (x, gap))
        frames.append(sheet.quantize(32))
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=60, loop=0, optimize=True)
