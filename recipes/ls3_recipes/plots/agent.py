"""Pictures of what an LS³ agent knows and plans: reconstructions, maps of its heads, timelines, candidate plans."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ls3_envs import Plane, VisualConstraintEnv
from ls3_recipes.plots.plane import Field, maps, over_plane, plane_of, plot_outlines, the_plane
from ls3_recipes.plots.style import GOAL, INK, PALE, SAFE, UNSAFE, Axes, Pictures, grid, image, line, picture
from ls3_recipes.run_settings import RunSettings
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag
from ls3_torchrl.modules import probability_of
from ls3_torchrl.modules.call import call_on_latent
from ls3_torchrl.planners import LS3Planner


def pictures_of_agent(
    folder: Path,
    settings: RunSettings,
    agent: LS3Agent,
    planner: LS3Planner,
    offline: Mapping[Tag, TensorDictBase],
    evaluation: TensorDictBase,
) -> Pictures:
    """What an LS³ agent knows and plans.

    Args:
        folder: the run's folder.
        settings: of the run.
        agent: trained.
        planner: its policy.
        offline: the demonstrations by tag.
        evaluation: the evaluation episodes ``[N, T]``.
    """
    pictures: Pictures = {
        "reconstructions.png": lambda: plot_reconstructions(folder, agent, offline),
        "timelines.png": lambda: plot_timelines(folder, agent, planner, offline, evaluation),
    }
    env = plane_of(settings.task)
    if env is not None:
        pictures["heatmaps.png"] = lambda: maps(folder, env, agent_fields(env, agent, planner), offline)
        pictures["plans.png"] = lambda: plot_plans(folder, env, agent, planner, evaluation[0])
    return pictures


@torch.no_grad()
def plot_reconstructions(
    folder: Path, agent: LS3Agent, offline: Mapping[Tag, TensorDictBase], columns: int = 12
) -> None:
    """Images above what the VAE makes of them, taken from all data."""
    frames = torch.cat([episode["pixels"][::7] for episodes in offline.values() for episode in episodes.unbind(0)])
    frames = frames[torch.linspace(0, len(frames) - 1, columns).long()]
    assert agent.decoder is not None
    td = agent.decoder(agent.encoder(TensorDict({"pixels": frames.to(_device(agent))}, [columns])))
    made = (td["reco_pixels"].clamp(0, 1) * 255).round().to(torch.uint8).cpu()
    with picture(folder / "reconstructions.png", 2, columns, (columns, 2.2)) as (figure, axes):
        for row, (images, name) in enumerate(((frames, "input"), (made, "VAE"))):
            for axis, pixels in zip(axes[row], images, strict=True):
                axis.imshow(image(pixels))
                axis.set_axis_off()
            axes[row, 0].set_title(name, loc="left")
        figure.subplots_adjust(wspace=0.05, hspace=0.25)


def _device(agent: LS3Agent) -> torch.device:
    return next(agent.parameters()).device


def _encode(agent: LS3Agent, pixels: Tensor) -> TensorDictBase:
    """What the encoder makes of images ``[n, C, S, S]``."""
    return agent.encoder(TensorDict({"pixels": pixels.to(_device(agent))}, [len(pixels)]))


def _values(agent: LS3Agent, latent: Tensor) -> Tensor:
    """Of every member, ``[n, M]``; M is 1 for a value that is no ensemble."""
    return call_on_latent(agent.value, latent).reshape(len(latent), -1)


def _correction(values: Tensor) -> int:
    """Bessel's, where there are two members or more."""
    return int(values.shape[-1] > 1)


@torch.no_grad()
def agent_fields(env: VisualConstraintEnv, agent: LS3Agent, planner: LS3Planner) -> dict[str, Field]:
    """Value, spread of the values, safe set, constraint and goal."""
    latent = over_plane(env, lambda pixels: _encode(agent, pixels))["latent"]
    values = _values(agent, latent)
    safe, unsafe = probability_of(agent.safe_set, latent), probability_of(agent.constraint, latent)
    return {
        "Value V": Field(values.mean(-1), "viridis"),
        "Spread of V over members": Field(values.std(-1, correction=_correction(values)), "magma"),
        _title("Safe set $f_S$", planner.safe_set_threshold): Field(
            safe, "BuGn", (0.0, 1.0), planner.safe_set_threshold
        ),
        _title("Constraint $f_C$", planner.constraint_threshold): Field(
            unsafe, "OrRd", (0.0, 1.0), planner.constraint_threshold
        ),
        "Goal $f_G$": Field(probability_of(agent.goal, latent), "Blues", (0.0, 1.0), 0.5),
    }


def _title(name: str, threshold: float | None) -> str:
    """A head's title, which says so where plans are made without it."""
    return name if threshold is not None else f"{name}, not asked"


@torch.no_grad()
def plot_plans(
    folder: Path,
    env: VisualConstraintEnv,
    agent: LS3Agent,
    planner: LS3Planner,
    episode: TensorDictBase,
    *,
    moments: int = 4,
) -> None:
    """Random candidate plans at moments of one episode: feasible or not, and the plan that was chosen.

    Positions are those that the true, noiseless domain would reach under the planned actions; the pale line is the
    whole episode.
    """
    plane = the_plane(env)
    times = np.linspace(0, 0.45 * len(episode), moments).astype(int)
    with picture(folder / "plans.png", 1, moments, (3.3 * moments, 3.0)) as (_, axes):
        for axis, t in zip(axes[0], times, strict=True):
            state = episode["state"][t]
            feasible = _plot_candidates(axis, env, plane, agent, planner, state)
            axis.plot(*line(plane.positions(episode["next", "state"])), color=PALE, lw=2.2, zorder=0)
            _zoom(axis, plane, plane.positions(state).tolist())
            axis.set_title(f"step {t}: {feasible:.0%} feasible")


def _plot_candidates(
    axis: Axes,
    env: VisualConstraintEnv,
    plane: Plane,
    agent: LS3Agent,
    planner: LS3Planner,
    state: Tensor,
    candidates: int = 150,
) -> float:
    """Candidates from a state and the chosen plan; the fraction of candidates that is feasible."""
    horizon, space = planner.horizon, planner.action_spec.space
    latent = _encode(agent, env.render_states(state[None]))["latent"]
    uniform = torch.rand(1, candidates, horizon, space.low.shape[-1], device=latent.device)
    actions = space.low + (space.high - space.low) * uniform
    threshold = torch.full((1, 1), planner.safe_set_threshold or 0.0, device=latent.device)
    feasible = planner.score_plans(planner.imagine_plans(latent, actions), threshold).feasible
    chosen = planner.plan(latent).actions
    for action, allowed in zip(actions[0].cpu(), feasible[0].cpu(), strict=True):
        axis.plot(*_path(env, plane, state, action), color=SAFE if allowed else UNSAFE, lw=0.5, alpha=0.45)
    axis.plot(*_path(env, plane, state, chosen[0].cpu()), color=INK, lw=2.2)
    axis.plot(*plane.positions(state).tolist(), "o", color=INK, ms=5)
    return float(feasible.float().mean())


def _path(env: VisualConstraintEnv, plane: Plane, state: Tensor, actions: Tensor) -> np.ndarray:
    """Where actions ``[H, A]`` lead from a state without noise."""
    states = [state]
    for action in actions:
        states.append(env.advance_noiseless(states[-1], action))
    return line(plane.positions(torch.stack(states)))


def _zoom(axis: Axes, plane: Plane, centre: list[float], fraction: float = 0.3) -> None:
    """Show the plane's outlines for a fraction of its extent to each side of a point."""
    plot_outlines(axis, plane)
    left, right, bottom, top = plane.extent
    (x, y), width, height = centre, fraction * (right - left), fraction * (top - bottom)
    axis.set(xlim=(x - width, x + width), ylim=(y - height, y + height))


@torch.no_grad()
def plot_timelines(
    folder: Path,
    agent: LS3Agent,
    planner: LS3Planner,
    offline: Mapping[Tag, TensorDictBase],
    evaluation: TensorDictBase,
) -> None:
    """What the heads say along a demonstration, a violation and an episode of the agent, under its frames."""
    shown = {"Demonstration": offline[Tag.SUCCESS][0]}
    if Tag.CONSTRAINT in offline:
        shown["Violating trajectory"] = offline[Tag.CONSTRAINT][0]
    shown["The agent"] = evaluation[0]
    size, heights = (4.6 * len(shown), 4.4), (0.55, 1, 1)
    with picture(folder / "timelines.png", 3, len(shown), size, height_ratios=heights) as (figure, axes):
        for (strip, value, heads), (title, episode) in zip(axes.T, shown.items(), strict=True):
            _plot_strip(strip, title, episode["next", "pixels"])
            latent = _encode(agent, episode["next", "pixels"])["latent"]
            _plot_values(value, _values(agent, latent).cpu())
            _plot_heads(heads, agent, planner, latent)
            for axis in (value, heads):
                _plot_events(axis, episode)
                axis.set_xlim(0, len(episode))
                grid(axis)
        axes[1, 0].set_ylabel("value V")
        axes[2, 0].set_ylabel("probability")
        figure.tight_layout()
        _legend(figure, planner)


def _legend(figure: Figure, planner: LS3Planner) -> None:
    """What lines and bands mean, in one row below all panels, where it hides nothing."""
    safe_set, constraint = planner.safe_set_threshold, planner.constraint_threshold
    band = Patch(color=INK, alpha=0.15, lw=0, label="spread over members")
    lines = (
        ("mean value", INK, 1.4, "-"),
        (_title("safe set $f_S$", safe_set), SAFE, 1.4, "-"),
        *([] if safe_set is None else [(r"threshold $\delta_S$", SAFE, 0.9, ":")]),
        (_title("constraint $f_C$", constraint), UNSAFE, 1.4, "-"),
        *([] if constraint is None else [(r"threshold $\delta_C$", UNSAFE, 0.9, ":")]),
        ("goal $f_G$", GOAL, 1.4, "-"),
        ("goal first reached", GOAL, 1.0, "|"),
        ("first violation", UNSAFE, 1.0, "|"),
    )
    handles: list[Artist] = [
        Line2D(
            [],
            [],
            color=colour,
            lw=0 if style == "|" else width,
            label=label,
            ms=9,
            mew=1.2,
            ls="none" if style == "|" else style,
            marker="|" if style == "|" else None,
        )
        for label, colour, width, style in lines
    ]
    handles.insert(1, band)
    figure.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncol=len(handles), fontsize=7)


def _plot_strip(axis: Axes, title: str, pixels: Tensor, frames: int = 7) -> None:
    chosen = torch.linspace(0, len(pixels) - 1, frames).long()
    strip = np.concatenate([image(pixels[t]) for t in chosen], axis=1)
    axis.imshow(strip, aspect="auto", extent=(0, len(pixels), 0, 1))
    axis.set(title=title, xticks=[], yticks=[])


def _plot_values(axis: Axes, values: Tensor) -> None:
    time, middle = np.arange(1, len(values) + 1), values.mean(-1).numpy()
    spread = values.std(-1, correction=_correction(values)).numpy()
    axis.plot(time, middle, color=INK, lw=1.4)
    axis.fill_between(time, middle - spread, middle + spread, color=INK, alpha=0.15, lw=0)


def _plot_heads(axis: Axes, agent: LS3Agent, planner: LS3Planner, latent: Tensor) -> None:
    time = np.arange(1, len(latent) + 1)
    heads = ((agent.safe_set, "safe set", SAFE), (agent.constraint, "constraint", UNSAFE), (agent.goal, "goal", GOAL))
    for head, name, colour in heads:
        axis.plot(time, probability_of(head, latent).flatten().cpu().numpy(), color=colour, lw=1.4, label=name)
    for level, colour in ((planner.safe_set_threshold, SAFE), (planner.constraint_threshold, UNSAFE)):
        if level is not None:
            axis.axhline(level, color=colour, lw=0.7, ls=":")
    axis.set(ylim=(-0.03, 1.03), xlabel="step")


def _plot_events(axis: Axes, episode: TensorDictBase) -> None:
    """A line where the goal is reached and where the constraint is violated first."""
    for key, colour in (("success", GOAL), ("constraint", UNSAFE)):
        happened = episode["next", key].flatten().nonzero().flatten()
        if len(happened):
            axis.axvline(int(happened[0]) + 1, color=colour, lw=1.0, alpha=0.6)
