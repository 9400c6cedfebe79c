"""Maps and outlines over the plane of a domain whose states are points of one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

import ls3_envs
from ls3_envs import Circle, Plane, VisualConstraintEnv
from ls3_recipes.plots.style import INK, SAFE, UNSAFE, Axes, line, picture, plt
from ls3_recipes.run_settings import TaskSettings
from ls3_torchrl.data import Tag


def plane_of(task: TaskSettings) -> VisualConstraintEnv | None:
    """The task's environment, where its states are a plane that maps can be drawn of."""
    env = ls3_envs.make(task.name, num_envs=1, seed=0).base_env
    return None if env.plane() is None else env


def the_plane(env: VisualConstraintEnv) -> Plane:
    """The plane of an environment that is known to have one."""
    plane = env.plane()
    assert plane is not None
    return plane


def plot_outlines(axis: Axes, plane: Plane) -> None:
    """Walls, goals and frame of a plane."""
    for shape in plane.outlines:
        if isinstance(shape, Circle):
            axis.add_patch(plt.Circle(shape.centre, shape.radius, fc="none", ec=INK, lw=1.2))
        else:
            width, height = (b - a for a, b in zip(shape.low, shape.high, strict=True))
            axis.add_patch(plt.Rectangle(shape.low, width, height, fc="none", ec=INK, lw=1.2))
    axis.set(xlim=plane.extent[:2], ylim=plane.extent[2:], xticks=[], yticks=[], aspect="equal")


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


def over_plane(env: VisualConstraintEnv, look: Callable[[Tensor], TensorDictBase]) -> TensorDictBase:
    """What ``look`` makes of the images ``[n, C, S, S]`` of all states of the plane."""
    states = the_plane(env).states.flatten(0, -2)
    return torch.cat([look(env.render_states(part)) for part in states.split(512)])


def states_of(episodes: TensorDictBase | None, count: int) -> list[Tensor]:
    """States ``[T, S]`` of the first episodes; none where there are no episodes, or none that keep states."""
    shown = () if episodes is None else episodes[:count].unbind(0)
    return [episode["state"] for episode in shown if episode.get("state", None) is not None]


def maps(
    folder: Path, env: VisualConstraintEnv, fields: Mapping[str, Field], offline: Mapping[Tag, TensorDictBase]
) -> None:
    """Fields over the plane, demonstrations drawn in."""
    plane = the_plane(env)
    with picture(folder / "heatmaps.png", 1, len(fields), (3.2 * len(fields), 3.0)) as (figure, axes):
        for axis, (title, field) in zip(axes[0], fields.items(), strict=True):
            shown = draw_field(axis, plane, field)
            for tag, colour in ((Tag.SUCCESS, SAFE), (Tag.CONSTRAINT, UNSAFE)):
                for track in states_of(offline.get(tag), 8):
                    axis.plot(*line(plane.positions(track)), color=colour, lw=0.5, alpha=0.6)
            plot_outlines(axis, plane)
            axis.set_title(title)
            figure.colorbar(shown, ax=axis, shrink=0.7, pad=0.02)


def draw_field(axis: Axes, plane: Plane, field: Field) -> object:
    """Draw a field over the plane; returns what a colour bar is made of."""
    values = field.values.reshape(plane.states.shape[:2]).cpu().numpy()
    low, high = field.limits or (values.min(), values.max())
    shown = axis.imshow(values, extent=plane.extent, cmap=field.colours, vmin=low, vmax=high, interpolation="nearest")
    if field.level is not None and values.min() < field.level < values.max():
        x, y = plane.positions(plane.states).unbind(-1)
        axis.contour(x.numpy(), y.numpy(), values, levels=[field.level], colors=INK, linewidths=0.8)
    return shown
