"""Pictures of what an LS³ agent knows and plans: reconstructions, maps of its heads, timelines, candidate plans."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

import ls3_envs
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag
from ls3_torchrl.planners import LS3Planner
from pictures import INK, PALE, SAFE, STYLE, UNSAFE, Field, line, maps, over_plane, plane_of, wall


def draw_agent(
    folder: Path,
    config: DictConfig,
    agent: LS3Agent,
    planner: LS3Planner,
    offline: dict[Tag, TensorDictBase],
    evaluation: TensorDictBase,
) -> None:
    """What an LS³ agent knows and plans. Arguments as for :func:`draw_run`, with the agent and its policy."""
    with plt.rc_context(STYLE), torch.no_grad():
        reconstructions(folder, agent, offline)
        timelines(folder, agent, planner, offline, evaluation)
        env = plane_of(config)
        if env is not None:
            maps(folder, env, agent_fields(env, agent, planner), offline)
            plans(folder, env, agent, planner, evaluation)


@torch.no_grad()
def reconstructions(folder: Path, agent: LS3Agent, offline: dict[Tag, TensorDictBase], columns: int = 12) -> None:
    """Images above what the VAE makes of them, drawn from all data."""
    frames = torch.cat([episodes["pixels"][:, ::7].flatten(0, 1) for episodes in offline.values()])
    frames = frames[torch.linspace(0, len(frames) - 1, columns).long()]
    td = agent.decoder(agent.encoder(TensorDict({"pixels": frames.to(_device(agent))}, [columns])))
    made = (td["reco_pixels"].clamp(0, 1) * 255).round().to(torch.uint8).cpu()
    figure, axes = plt.subplots(2, columns, figsize=(columns, 2.2))
    for column in range(columns):
        for row, (images, name) in enumerate(((frames, "input"), (made, "VAE"))):
            axes[row, column].imshow(images[column, -3:].permute(1, 2, 0).numpy())
            axes[row, column].set_axis_off()
            if column == 0:
                axes[row, 0].set_title(name, loc="left")
    figure.subplots_adjust(wspace=0.05, hspace=0.25)
    figure.savefig(folder / "reconstructions.png")
    plt.close(figure)


def _device(agent: LS3Agent) -> torch.device:
    return next(agent.parameters()).device


def _encode(agent: LS3Agent, pixels: Tensor) -> TensorDictBase:
    """What the encoder makes of images ``[n, C, S, S]``."""
    return agent.encoder(TensorDict({"pixels": pixels.to(_device(agent))}, [len(pixels)]))


def agent_fields(env: ls3_envs.VisualConstraintEnv, agent: LS3Agent, planner: LS3Planner) -> dict[str, Field]:
    """Value, spread of the values, safe set, constraint and goal."""
    latent = over_plane(env, lambda pixels: _encode(agent, pixels))["latent"]
    values = agent.value(TensorDict({"latent": latent}, [len(latent)]))["state_value"].squeeze(-1)
    heads = ((agent.safe_set, planner.safe_set_threshold), (agent.constraint, planner.constraint_threshold))
    (safe, s_level), (unsafe, c_level) = ((head.probability(latent), level) for head, level in heads)
    return {
        "Value V": Field(values.mean(-1), "viridis"),
        "Spread of V over members": Field(values.std(-1), "magma"),
        "Safe set $f_S$": Field(safe, "BuGn", (0.0, 1.0), s_level),
        "Constraint $f_C$": Field(unsafe, "OrRd", (0.0, 1.0), c_level),
        "Goal $f_G$": Field(agent.goal.probability(latent), "Blues", (0.0, 1.0), 0.5),
    }


@torch.no_grad()
def plans(
    folder: Path,
    env: ls3_envs.VisualConstraintEnv,
    agent: LS3Agent,
    planner: LS3Planner,
    evaluation: TensorDictBase,
    *,
    moments: int = 4,
    candidates: int = 150,
) -> None:
    """Random candidate plans at moments of one episode: feasible or not, and the plan that was chosen.

    Positions are those that the true, noiseless world would reach under the planned actions; the pale line is the
    whole episode.
    """
    plane = env.plane()
    assert plane is not None
    extent = plane[1]
    episode = evaluation[0]
    horizon, space = planner.horizon, planner.action_spec.space
    figure, axes = plt.subplots(1, moments, figsize=(3.3 * moments, 3.0))
    for axis, t in zip(axes, np.linspace(0, 0.45 * len(episode), moments).astype(int), strict=True):
        state = episode["state"][t]
        latent = _encode(agent, env.render_states(state[None]))["latent"]
        draws = torch.rand(1, candidates, horizon, space.low.shape[-1], device=latent.device)
        actions = space.low + (space.high - space.low) * draws
        verdict = planner.score_plans(
            planner.statistics(latent, actions),
            torch.full((1, 1), planner.safe_set_threshold, device=latent.device),
        )
        chosen = planner.plan(latent).actions
        for action, allowed in zip(actions[0].cpu(), verdict.feasible[0].cpu(), strict=True):
            track = torch.cat([state[None], state + action.cumsum(0)])
            axis.plot(*line(track), color=SAFE if allowed else UNSAFE, lw=0.5, alpha=0.45)
        track = torch.cat([state[None], state + chosen[0].cpu().cumsum(0)])
        axis.plot(*line(track), color=INK, lw=2.2)
        axis.plot(*line(episode["next", "state"]), color=PALE, lw=2.2, zorder=0)
        axis.plot(*state.tolist(), "o", color=INK, ms=5)
        wall(axis, extent)
        centre = state.tolist()
        axis.set(xlim=(centre[0] - 54, centre[0] + 54), ylim=(centre[1] + 45, centre[1] - 45))
        axis.set_title(f"step {t}: {verdict.feasible.float().mean():.0%} feasible")
    figure.savefig(folder / "plans.png")
    plt.close(figure)


@torch.no_grad()
def timelines(
    folder: Path,
    agent: LS3Agent,
    planner: LS3Planner,
    offline: dict[Tag, TensorDictBase],
    evaluation: TensorDictBase,
    *,
    frames: int = 7,
) -> None:
    """What the heads say along a demonstration, a violation and an episode of the agent, under its frames."""
    shown = {"Demonstration": offline[Tag.SUCCESS][0]}
    if Tag.CONSTRAINT in offline:
        shown["Violating trajectory"] = offline[Tag.CONSTRAINT][0]
    shown["The agent"] = evaluation[0]
    figure, axes = plt.subplots(3, len(shown), figsize=(4.6 * len(shown), 4.4), height_ratios=(0.55, 1, 1))
    for column, (title, episode) in zip(axes.T.reshape(len(shown), 3), shown.items(), strict=True):
        pixels = episode["next", "pixels"]
        chosen = torch.linspace(0, len(pixels) - 1, frames).long()
        strip = torch.cat([image[-3:] for image in pixels[chosen].cpu()], -1)
        column[0].imshow(strip.permute(1, 2, 0).numpy(), aspect="auto", extent=(0, len(pixels), 0, 1))
        column[0].set(title=title, xticks=[], yticks=[])
        latent = _encode(agent, pixels)["latent"]
        values = agent.value(TensorDict({"latent": latent}, [len(latent)]))["state_value"].squeeze(-1).cpu()
        time = np.arange(1, len(pixels) + 1)
        middle, spread = values.mean(-1).numpy(), values.std(-1).numpy()
        column[1].plot(time, middle, color=INK, lw=1.4)
        column[1].fill_between(time, middle - spread, middle + spread, color=INK, alpha=0.15, lw=0)
        heads = ((agent.safe_set, "safe set", SAFE), (agent.constraint, "constraint", UNSAFE))
        for head, name, colour in (*heads, (agent.goal, "goal", "#e0a458")):
            column[2].plot(time, head.probability(latent).flatten().cpu().numpy(), color=colour, lw=1.4, label=name)
        for level, colour in ((planner.safe_set_threshold, SAFE), (planner.constraint_threshold, UNSAFE)):
            column[2].axhline(level, color=colour, lw=0.7, ls=":")
        for key, colour in (("success", "#e0a458"), ("constraint", UNSAFE)):
            happened = episode["next", key].flatten().nonzero().flatten()
            if len(happened):
                for axis in column[1:]:
                    axis.axvline(int(happened[0]) + 1, color=colour, lw=1.0, alpha=0.6)
        column[2].set(ylim=(-0.03, 1.03), xlabel="step")
        for axis in column[1:]:
            axis.set_xlim(0, len(pixels))
            axis.grid(color=PALE, alpha=0.4, lw=0.6)
    axes.reshape(3, -1)[1, 0].set_ylabel("value V")
    axes.reshape(3, -1)[2, 0].set_ylabel("probability")
    axes.reshape(3, -1)[2, 0].legend(loc="center left", fontsize=7)
    figure.tight_layout()
    figure.savefig(folder / "timelines.png")
    plt.close(figure)
