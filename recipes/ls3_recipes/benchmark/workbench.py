"""What every figure is measured with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded

import ls3_envs
from ls3_recipes.algorithms.settings.ls3 import LS3Settings
from ls3_recipes.benchmark.tables import Section
from ls3_recipes.benchmark.timing import Bench
from ls3_recipes.command_settings import BenchmarkSettings
from ls3_recipes.configuration import train_settings


@dataclass(frozen=True)
class Workbench:
    """Stopwatch, settings and data that the figures share.

    Attributes:
        settings: of the benchmark.
        presets: what its presets set, in their order.
        device: that is computed on.
        bench: collects what is timed.
        folder: that everything is written to.
        spec: bounds of one action of the task.
        episodes: demonstrations ``[8, T]``.
        sections: tables, to which the figures add theirs.
    """

    settings: BenchmarkSettings
    presets: Sequence[LS3Settings]
    device: torch.device
    bench: Bench
    folder: Path
    spec: Bounded
    episodes: TensorDictBase
    sections: list[Section] = field(default_factory=list)


def make_workbench(
    settings: BenchmarkSettings, presets: Sequence[LS3Settings], device: torch.device, folder: Path
) -> Workbench:
    """With the task's bounds and a few of its demonstrations."""
    space = ls3_envs.make(settings.task, num_envs=1, seed=0).action_spec.space
    spec = Bounded(low=space.low[0], high=space.high[0], shape=space.low.shape[1:], device=device)
    episodes = ls3_envs.collect_offline(settings.task, "success", episodes=8, seed=0)
    return Workbench(settings, presets, device, Bench(settings.seconds), folder, spec, episodes)


def preset_settings(task: str, preset: str) -> LS3Settings:
    """What a preset sets for a task, as the recipe composes it.

    Raises:
        ValueError: for an unknown preset.
    """
    settings = train_settings(f"task={task}", f"preset={preset}")
    assert isinstance(settings, LS3Settings)
    return settings
