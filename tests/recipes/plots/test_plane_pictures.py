"""Maps and outlines of any domain with a plane: none is known by name."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from matplotlib.patches import Circle as Disc
from matplotlib.patches import Rectangle as Box
from PIL import Image
from tensordict import TensorDict

import ls3_envs
from ls3_envs import Circle, Plane, Rectangle
from ls3_recipes import plots
from ls3_recipes.plots.plane import Field, maps, over_plane, plane_of, plot_outlines
from ls3_recipes.run_settings import TaskSettings
from ls3_torchrl.data import Tag


class Sloped:
    """Stands for a domain whose plane is the second and third entry of its state."""

    def plane(self):
        y, x = torch.meshgrid(torch.arange(4.0), torch.arange(6.0), indexing="ij")
        states = torch.stack([torch.full_like(x, 7.0), x, y], -1)
        return Plane(states, (0.0, 5.0, 3.0, 0.0), (Rectangle((1.0, 0.0), (2.0, 3.0)), Circle((4.0, 1.0), 0.5)), (1, 2))

    def render_states(self, state):
        return state[:, :, None, None].expand(-1, 3, 2, 2)


def test_no_picture_knows_a_domain_by_name():
    for path in Path(plots.__file__).parent.glob("*.py"):
        words = path.read_text().lower()
        assert not [name for name in ls3_envs.DOMAINS if name in words], path.name


def test_walls_and_goals_are_drawn_where_the_plane_has_them():
    _, axis = plt.subplots()
    plot_outlines(axis, Sloped().plane())
    wall, goal = axis.patches
    assert isinstance(wall, Box)
    assert (wall.get_xy(), wall.get_width(), wall.get_height()) == ((1.0, 0.0), 1.0, 3.0)
    assert isinstance(goal, Disc)
    assert (goal.center, goal.radius) == ((4.0, 1.0), 0.5)
    assert (axis.get_xlim(), axis.get_ylim()) == ((0.0, 5.0), (3.0, 0.0))
    plt.close("all")


def test_every_state_of_the_plane_is_looked_at_in_its_order():
    seen = over_plane(Sloped(), lambda pixels: TensorDict({"x": pixels[:, 1, 0, 0], "y": pixels[:, 2, 0, 0]}, [24]))
    assert seen["x"].tolist() == [*range(6)] * 4
    assert seen["y"].tolist() == [row for row in range(4) for _ in range(6)]


def test_a_map_shows_its_values_and_the_demonstrations(tmp_path):
    tracks = torch.rand(1, 5, 3) * 3
    fields = {"A": Field(torch.arange(24.0), "viridis", level=11.5), "B": Field(torch.zeros(24), "magma", (0.0, 1.0))}
    for offline in ({}, {Tag.SUCCESS: TensorDict({"state": tracks}, [1, 5])}):
        maps(tmp_path, Sloped(), fields, offline)
        pixels = np.asarray(Image.open(tmp_path / "heatmaps.png").convert("RGB"))
        assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20


@pytest.mark.parametrize(("name", "there"), [("navigation", True), ("cable_routing", False)])
def test_only_domains_with_a_plane_are_mapped(name, there):
    assert (plane_of(TaskSettings(name=name)) is not None) == there
