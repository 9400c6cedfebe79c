"""What agents knew through training: value and safe set over the plane, update by update."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.algorithms.ls3 import LS3
from ls3_recipes.configuration import settings_of_run
from ls3_recipes.plots.agent import agent_fields
from ls3_recipes.plots.plane import draw_field, plane_of, plot_outlines, states_of, the_plane
from ls3_recipes.plots.style import INK, line, picture
from ls3_recipes.report.reading import Run
from ls3_recipes.rollout import make_env
from ls3_recipes.run_settings import TaskSettings
from ls3_torchrl.data import Tag, load_episodes

#: Fields that are drawn, of all that an agent has.
SHOWN = ("Value V", "Safe set $f_S$", "Constraint $f_C$")


def has_maps(run: Run) -> bool:
    """Whether a run's agents know something that can be drawn over a plane."""
    return run.algorithm == "ls3" and len(_agents(run)) > 1 and plane_of(TaskSettings(name=run.task)) is not None


def plot_maps(run: Run, path: Path, columns: int = 5) -> None:
    """Value, safe set and constraint of agents through training, with the online episodes that followed.

    Args:
        run: of LS³, on a domain whose states are a plane.
        path: of the picture.
        columns: agents, from the one after offline training to the last.
    """
    settings, agents = settings_of_run(run.folder), _agents(run)
    env = plane_of(settings.task)
    assert env is not None
    plane = the_plane(env)
    algorithm = ALGORITHMS["ls3"].load()(
        settings, make_env(settings.task, 1, 0, torch.device("cpu")), torch.device("cpu")
    )
    assert isinstance(algorithm, LS3)
    chosen = np.unique(np.linspace(0, len(agents) - 1, columns).round().astype(int))
    with picture(path, len(SHOWN), len(chosen), (2.9 * len(chosen), 2.5 * len(SHOWN))) as (figure, axes):
        for column, number in zip(axes.T, chosen, strict=True):
            algorithm.restore(agents[number])
            update = int(agents[number].stem.removeprefix("agent_"))
            fields = agent_fields(env, algorithm.agent, algorithm.policy)
            drawn = [field for title, field in fields.items() if title.startswith(SHOWN)]
            for axis, field, title in zip(column, drawn, SHOWN, strict=True):
                draw_field(axis, plane, field)
                plot_outlines(axis, plane)
                for track in _tracks(run, update + 1):
                    axis.plot(*line(plane.positions(track)), color=INK, lw=0.6, alpha=0.7)
                if number == chosen[0]:
                    axis.set_ylabel(title)
            column[0].set_title("offline" if update == 0 else f"update {update}")
        figure.tight_layout()


def _agents(run: Run) -> Sequence[Path]:
    return sorted((run.folder / "checkpoints").glob("agent_*.pt"))


def _tracks(run: Run, update: int) -> list[torch.Tensor]:
    """Where the agent went in the episodes that it collected next."""
    folder = run.folder / "episodes" / f"update_{update:03d}"
    return states_of(load_episodes(folder)[Tag.ONLINE], 8) if folder.is_dir() else []
