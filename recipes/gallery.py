"""A picture of every domain: its start, a demonstration and a violation."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDictBase
from torch import Tensor

import ls3_envs
from common import console
from ls3_envs.demonstrators import collect_episodes
from pictures import INK, SAFE, STYLE, UNSAFE

COLUMNS = 9


def _episodes(name: str, kind: str) -> TensorDictBase:
    """Some episodes in colour, one frame a picture."""
    recipe = ls3_envs.domain(name).offline[kind]
    options = dict(recipe.env_options)
    if name == "cable_routing":
        options["observation"] = "rgb"
    return collect_episodes(ls3_envs.make(name, 6, frames=1, seed=0, **options), recipe.policy(seed=0))


def _moments(flags: Tensor) -> Tensor:
    """Steps from the first to shortly after the flag rises, evenly spaced."""
    end = min(int(flags.flatten().int().argmax()) + 4, len(flags)) - 1
    return torch.linspace(0, end, COLUMNS).round().long()


def gallery(path: Path) -> Path:
    """Draw all domains into one file."""
    names = list(ls3_envs.DOMAINS)
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(2 * len(names), COLUMNS, figsize=(COLUMNS, 2.25 * len(names)))
        for axis in axes.flat:
            axis.set_axis_off()
        for i, name in enumerate(names):
            for j, (kind, key, colour) in enumerate(
                (("success", "success", SAFE), ("constraint", "constraint", UNSAFE))
            ):
                episodes = _episodes(name, kind)
                happened = episodes["next", key].any(1).flatten()
                episode = episodes[int(happened.int().argmax())]
                row = axes[2 * i + j]
                for axis, t in zip(row, _moments(episode["next", key]).tolist(), strict=True):
                    axis.imshow(episode["next", "pixels"][t].permute(1, 2, 0).numpy())
                    axis.text(2, 60, str(t + 1), color="white", fontsize=6, bbox={"fc": INK, "ec": "none", "pad": 1.2})
                    if bool(episode["next", key][t]):
                        frame = plt.Rectangle((-0.5, -0.5), 64, 64, fc="none", ec=colour, lw=4)
                        axis.add_patch(frame)
                title = {"success": "a demonstration", "constraint": "a violation"}[kind]
                row[0].set_title(f"{name.replace('_', ' ')}: {title}", loc="left")
        figure.subplots_adjust(wspace=0.06, hspace=0.45)
        figure.savefig(path)
        plt.close(figure)
    return path


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("Usage: python recipes/gallery.py FILE.png")
    console.print(f"All domains are in [bold]{gallery(Path(sys.argv[1]))}[/bold]")
