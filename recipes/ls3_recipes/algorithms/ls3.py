"""LS³ under the protocol: the VAE, the latent models, and the planner that acts by them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.record.loggers import Logger

from ls3_recipes.algorithms.base import Algorithm, make_agent
from ls3_recipes.algorithms.settings.ls3 import LS3Settings
from ls3_recipes.figures import as_one_shape
from ls3_recipes.options import as_dict, errors_of
from ls3_recipes.plots.agent import pictures_of_agent
from ls3_recipes.plots.style import Label, Pictures
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, TaggedReplayBuffer
from ls3_torchrl.planners import describe_plan
from ls3_torchrl.trainers import (
    LS3Trainer,
    StateProbe,
    VAETrainer,
)


class LS3(Algorithm):
    """VAE, latent models and planner, in the paper's order."""

    key = name = "ls3"
    labels = {"ls3": Label("LS³", "#1b7f79")}  # noqa: RUF012
    needs = (Tag.SUCCESS, Tag.CONSTRAINT)

    def __init__(self, settings: LS3Settings, env: TransformedEnv, device: torch.device) -> None:
        self.settings: LS3Settings = settings
        options = as_dict(settings.planner)
        self.agent = make_agent(settings, env, device, planner=options)
        with errors_of("planner", options):
            self.policy = self.agent.planner()

    def prepare(self, env: TransformedEnv) -> None:
        """The planner carries its last plan on from step to step."""
        env.append_transform(self.policy.make_tensordict_primer())

    def begin(
        self, buffer: TaggedReplayBuffer, logger: Logger, horizon: int, after_step: Callable[[], object] | None = None
    ) -> None:
        """Make the learners of every equation."""
        how: dict[str, Any] = {"logger": logger, "after_step": after_step}
        self.vae = VAETrainer(self.agent, buffer, self.settings.vae, **how)
        self.trainer = LS3Trainer(self.agent, buffer, self.settings.training, **how)

    def phases(self) -> dict[str, Callable[[], None]]:
        """Equation (1), then the others on its latents."""
        return {"vae": self.vae.train, "offline": self.trainer.train_offline}

    def update(self) -> None:
        """One update of all latent models."""
        self.trainer.update()

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, lagged networks and counters."""
        return {
            "agent": self.agent.state_dict(),
            "vae": None if self.vae.finished else self.vae.state_dict(),
            "learners": self.trainer.state_dict(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken."""
        self.agent.load_state_dict(state_dict["agent"])
        if state_dict["vae"] is None:
            self.vae.finished = True
        else:
            self.vae.load_state_dict(state_dict["vae"])
        self.trainer.load_state_dict(state_dict["learners"])

    def encode(self) -> None:
        """Fill the latents of the buffer again."""
        self.vae.encode()

    def describe(self, episodes: TensorDictBase) -> dict[str, float]:
        """How often the planner relaxed the safe set or fell back."""
        return dict(describe_plan(episodes).to_dict())

    def diagnose(self, offline: dict[Tag, TensorDictBase], evaluation: TensorDictBase) -> dict[str, float]:
        """How well latents and imagination know the simulator's state, where the episodes keep it."""
        return probe(self.agent, list(offline.values()), evaluation, self.policy.horizon)

    @property
    def vae_agent(self) -> LS3Agent:
        """The agent."""
        return self.agent

    def save(self, path: Path) -> Path:
        """As a file of :class:`~ls3_torchrl.LS3Agent`."""
        return self.agent.save(path)

    def restore(self, path: Path) -> None:
        """Take the networks of such a file; one of another shape, or with actions in other units, is refused."""
        loaded = LS3Agent.load(path, **asdict(self.agent.architecture))
        if loaded.decoder is None:  # a compact file
            self.agent.decoder = None
        self.agent.load_state_dict(loaded.state_dict())

    def pictures(self, folder: Path, offline: dict[Tag, TensorDictBase], evaluation: TensorDictBase) -> Pictures:
        """Reconstructions, timelines, and maps and plans where the states are a plane."""
        return pictures_of_agent(folder, self.settings, self.agent, self.policy, offline, evaluation)


def probe(agent: LS3Agent, offline: list[TensorDictBase], evaluation: TensorDictBase, horizon: int) -> dict[str, float]:
    """Errors of a state read from latents, and from latents imagined ``horizon`` steps ahead.

    Nothing where the episodes keep no state, or are shorter than the horizon.
    """
    offline = [as_one_shape(part) for part in offline]
    episodes = [*offline, evaluation]
    if any(part.get("state", None) is None for part in episodes) or evaluation.shape[1] < horizon:
        return {}
    latents = StateProbe(agent, offline)
    # What was imagined on the agent's own way is read by a probe that has seen the way.
    imagined = StateProbe(agent, episodes).imagination_error(evaluation, horizon=horizon)
    return {"state_error": round(latents.error, 3), f"imagined_{horizon}_steps_error": round(imagined, 3)}
