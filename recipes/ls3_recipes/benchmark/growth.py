"""Cost as work grows: the same work at a geometric series of sizes, and the exponent that fits best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from ls3_recipes.benchmark.planning import permissive
from ls3_recipes.benchmark.tables import Section, milliseconds
from ls3_recipes.benchmark.updates import vae_step
from ls3_recipes.benchmark.workbench import Workbench
from ls3_recipes.options import as_dict
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import BatchStream, Tag, TaggedReplayBuffer
from ls3_torchrl.layers import fastest_precision
from ls3_torchrl.objectives import EnsembleDynamicsLoss, VAELoss

#: Sizes of each figure; with ``smoke`` the first two.
SIZES: dict[str, tuple[int, ...]] = {
    "candidates": (50, 100, 200, 400, 800, 1600),
    "particles": (2, 4, 8, 16, 32),
    "horizon": (1, 2, 4, 8, 16),
    "worlds": (1, 2, 4, 8, 16, 32),
    "episodes": (4, 8, 16, 32, 64),
    "images": (16, 32, 64, 128, 256),
}
_LETTERS = {"candidates": "N", "particles": "P", "horizon": "H", "worlds": "B"}
_OPTIONS = {"candidates": "num_candidates", "particles": "num_particles", "horizon": "horizon"}
#: What makes the work of a size, ready to be timed.
Maker = Callable[[int], Callable[[], object]]


@dataclass(frozen=True)
class Curve:
    """Cost of one kind of work at several sizes.

    Attributes:
        figure: a name in :data:`SIZES`.
        what: the work.
        unit: of the sizes.
        sizes: in rising order.
        median_ms: of repetitions, at each size.
        iqr_ms: their interquartile range.
        exponent: of the power of the size that fits best.
    """

    figure: str
    what: str
    unit: str
    sizes: tuple[int, ...]
    median_ms: tuple[float, ...]
    iqr_ms: tuple[float, ...]
    exponent: float


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """The slope of the least-squares line through the logarithms: b where costs are a · size^b.

    Raises:
        ValueError: for fewer than two sizes, and for what has no logarithm.

    Example:
        >>> round(exponent([1, 2, 4, 8], [3, 6, 12, 24]), 6)
        1.0
    """
    if len(set(sizes)) < 2 or min(*sizes, *costs) <= 0.0:
        raise ValueError(f"An exponent needs two sizes, and costs above 0; got sizes {sizes} and costs {costs}.")
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def measure_growth(work: Workbench, figure: str) -> list[dict[str, Any]]:
    """Time a figure at all of its sizes.

    Returns:
        Its curves, as dictionaries.
    """
    makers = {"episodes": _episodes, "images": _images}.get(figure, partial(_plans, figure=figure))(work)
    unit = {"episodes": "episodes", "images": "images"}.get(figure, f"{figure} {_LETTERS.get(figure, '')}".strip())
    sizes = SIZES[figure][: 2 if work.settings.smoke else None]
    curves = [_curve(work, figure, what, unit, sizes, make) for what, make in makers.items()]
    return [asdict(curve) for curve in curves]


def _curve(work: Workbench, figure: str, what: str, unit: str, sizes: tuple[int, ...], make: Maker) -> Curve:
    before = len(work.bench.rows)
    for size in sizes:
        short = f"{_LETTERS[figure]} {size}" if figure in _LETTERS else f"{size} {unit}"
        work.bench.time(f"{what}, {short}", make(size))
    rows = work.bench.rows[before:]
    medians = tuple(row["median_ms"] for row in rows)
    spreads = tuple(row["iqr_ms"] for row in rows)
    return Curve(figure, what, unit, sizes, medians, spreads, exponent(sizes, medians))


def _plans(work: Workbench, figure: str) -> dict[str, Maker]:
    """Plans of the first preset; all but one size as it has them, for one world."""
    preset = work.presets[0]
    torch.manual_seed(0)
    agent = permissive(LS3Agent(action_spec=work.spec, **as_dict(preset.agent))).to(work.device)
    options = as_dict(preset.planner)

    def make(size: int) -> Callable[[], object]:
        changes = {_OPTIONS[figure]: size} if figure in _OPTIONS else {}
        planner = agent.planner(work.spec, **(options | changes))
        worlds = size if figure == "worlds" else 1
        latent = torch.randn(worlds, agent.architecture.latent_dim, device=work.device)
        return lambda: planner.plan(latent)

    return {"plan": make}


def _episodes(work: Workbench) -> dict[str, Maker]:
    """Encoding all frames of a buffer, and drawing the batch of an ensemble from it."""
    preset, episodes = work.presets[0], work.episodes
    agent = LS3Agent(action_spec=work.spec, in_channels=episodes["pixels"].shape[-3], **as_dict(preset.agent))
    agent = agent.to(work.device)
    loss = EnsembleDynamicsLoss(agent.dynamics, bootstrap=True)

    def filled(size: int) -> TaggedReplayBuffer:
        count, steps = episodes.shape[:2]
        buffer = TaggedReplayBuffer(size * steps, latent_dim=agent.architecture.latent_dim, device=work.device)
        buffer.add(episodes[torch.arange(size) % count], Tag.SUCCESS)
        return buffer

    def encoding(size: int) -> Callable[[], object]:
        buffer = filled(size)
        return lambda: buffer.encode(agent.encoder)

    def drawing(size: int) -> Callable[[], object]:
        buffer = filled(size)
        buffer.encode(agent.encoder)
        return BatchStream(buffer, preset.optim.batch_size, reads=loss, members=agent.architecture.num_dynamics)

    return {"encoding": encoding, "drawing a batch": drawing}


def _images(work: Workbench) -> dict[str, Maker]:
    """A gradient step of the VAE, and encoding."""
    preset, frames = work.presets[0], work.episodes["pixels"].flatten(0, 1)
    agent = LS3Agent(action_spec=work.spec, in_channels=frames.shape[1], **as_dict(preset.agent)).to(work.device)
    assert agent.decoder is not None
    for half in (agent.encoder, agent.decoder):
        half.to(memory_format=torch.channels_last)
    loss = VAELoss(agent.encoder, agent.decoder)
    precision = fastest_precision(work.device.type)

    def rows(size: int) -> TensorDict:
        pixels = frames[torch.arange(size) % len(frames)]
        return TensorDict({"pixels": pixels}, [size]).to(work.device)

    def step(size: int) -> Callable[[], object]:
        return vae_step(loss, rows(size), precision)

    def encoding(size: int) -> Callable[[], object]:
        pixels = rows(size)
        return torch.no_grad()(lambda: agent.encoder(pixels.copy()))

    return {"VAE step": step, "encoding": encoding}


def growth_section(curves: Sequence[dict[str, Any]], preset: str) -> Section:
    """A line for each curve: sizes, costs and exponent."""
    lines = []
    for curve in curves:
        first, last = (milliseconds(curve["median_ms"][i])[0] for i in (0, -1))
        spread = max(iqr / median for iqr, median in zip(curve["iqr_ms"], curve["median_ms"], strict=True))
        sizes = f"{curve['sizes'][0]} to {curve['sizes'][-1]}"
        lines.append(
            (f"{curve['what']}, {curve['unit']}", sizes, first, last, f"{spread:.0%}", f"{curve['exponent']:.2f}")
        )
    columns = ("", "sizes", "ms at the first", "ms at the last", "largest spread", "exponent")
    caption = (
        f"preset {preset}; twice the work takes 2^exponent times as long: 1 is in proportion, less is overhead that is "
        "shared; spread: interquartile range by median"
    )
    return Section("Cost as work grows", columns, lines, caption)
