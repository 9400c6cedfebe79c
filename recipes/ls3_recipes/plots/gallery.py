"""A picture of every domain: a demonstration and a violation, from the start."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

import ls3_envs
from ls3_envs.demonstrators import collect_episodes
from ls3_recipes.plots.style import INK, SAFE, UNSAFE, Axes, image, picture, plt

COLUMNS = 9
#: What is shown of a domain: kind of its offline data, colour of what happens in it, words.
ROWS = (("success", SAFE, "a demonstration"), ("constraint", UNSAFE, "a violation"))


class Coloured(Transform):
    """Adds ``("next", "colour")``: the domain in colour, whatever the agent sees."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("colour", self.parent.base_env.render_rgb())


def plot_gallery(path: Path, domains: Sequence[str]) -> Path:
    """Draw domains into one file."""
    size = (COLUMNS, 2.25 * len(domains))
    with picture(path, len(ROWS) * len(domains), COLUMNS, size) as (figure, axes):
        for axis in axes.flat:
            axis.set_axis_off()
        rows = iter(axes)
        for name in domains:
            for kind, colour, words in ROWS:
                row = next(rows)
                _plot_episode(row, example(name, kind), kind, colour)
                row[0].set_title(f"{name.replace('_', ' ')}: {words}", loc="left")
        figure.subplots_adjust(wspace=0.06, hspace=0.45)
    return path


def example(name: str, kind: str) -> TensorDictBase:
    """An episode ``[T]`` of a domain's offline data in which happens what it is for."""
    recipe = ls3_envs.domain(name).offline[kind]
    env = ls3_envs.make(name, 6, frames=1, seed=0, **recipe.env_options)
    env.append_transform(Coloured())
    episodes = collect_episodes(env, recipe.policy(seed=0))
    happened = episodes["next", kind].any(1).flatten()
    return episodes[int(happened.int().argmax())]


def moments(flags: Tensor) -> Tensor:
    """Steps from the first to shortly after the flag rises, evenly spaced."""
    end = min(int(flags.flatten().int().argmax()) + 4, len(flags)) - 1
    return torch.linspace(0, end, COLUMNS).round().long()


def _plot_episode(axes: Sequence[Axes], episode: TensorDictBase, kind: str, colour: str) -> None:
    for axis, t in zip(axes, moments(episode["next", kind]).tolist(), strict=True):
        pixels = episode["next", "colour"][t]
        axis.imshow(image(pixels))
        side = pixels.shape[-1]
        axis.text(2, side - 4, str(t + 1), color="white", fontsize=6, bbox={"fc": INK, "ec": "none", "pad": 1.2})
        if bool(episode["next", kind][t]):
            axis.add_patch(plt.Rectangle((-0.5, -0.5), side, side, fc="none", ec=colour, lw=4))
