"""LS³ end to end: demonstrations, offline training, online improvement, evaluation, pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

import agent_pictures
from common import RunFolder
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, TaggedReplayBuffer
from ls3_torchrl.planners import describe_plan
from probe import StateProbe
from protocol import Algorithm, follow
from representation import train_vae
from settings import agent_options, check_settings
from training import Training


def probe(agent: LS3Agent, offline: list[TensorDictBase], evaluation: TensorDictBase, horizon: int) -> dict[str, float]:
    """How well latents and imagination know the simulator's state, where the episodes keep it (and are long enough)."""
    episodes = [*offline, evaluation]
    if any(part.get("state", None) is None for part in episodes) or evaluation.shape[1] < horizon:
        return {}
    latents = StateProbe(agent, offline)
    # What was imagined on the agent's own way is read by a probe that has seen the way.
    imagined = StateProbe(agent, episodes).imagination_error(evaluation, horizon=horizon)
    return {"state_error": round(latents.error, 3), f"imagined_{horizon}_steps_error": round(imagined, 3)}


class LS3(Algorithm):
    """VAE, latent models and planner, in the paper's order."""

    name = "ls3"
    needs = (Tag.SUCCESS, Tag.CONSTRAINT)

    def __init__(self, config: DictConfig, env: TransformedEnv, device: torch.device) -> None:
        check_settings(config)
        self.config = config
        self.agent = LS3Agent(
            action_dim=env.action_spec.shape[-1],
            in_channels=env.observation_spec["pixels"].shape[-3],
            **agent_options(config, env.action_spec),
        ).to(device)
        self.policy = self.agent.planner(env.action_spec, **config.planner)

    def prepare(self, env: TransformedEnv) -> None:
        """The planner carries its last plan on from step to step."""
        env.append_transform(self.policy.make_tensordict_primer())

    def make_buffer(self, device: torch.device, **labels: Any) -> TaggedReplayBuffer:
        """Failures may go on for ever in its returns."""
        return super().make_buffer(device, continue_failures=self.config.loss.continue_failures, **labels)

    def begin(self, buffer: TaggedReplayBuffer, run: RunFolder, horizon: int) -> None:
        """Make the learners of every equation."""
        self.buffer, self.run = buffer, run
        self.training = Training(self.agent, buffer, self.config, run, horizon=horizon)

    def phases(self) -> dict[str, Callable[[], None]]:
        """Equation (1), then the others on its latents."""
        return {
            "vae": lambda: train_vae(self.agent, self.buffer, self.config, self.run),
            "offline": self.training.train_offline,
        }

    def train_online(self) -> None:
        """One update of all latent models."""
        self.training.train_online()

    def describe(self, episodes: TensorDictBase) -> dict[str, float]:
        """How often the planner relaxed the safe set or fell back."""
        return dict(describe_plan(episodes).to_dict())

    def diagnose(self, offline: dict[Tag, TensorDictBase], evaluation: TensorDictBase) -> dict[str, float]:
        """How much of the world's state latents and imagination hold."""
        return probe(self.agent, list(offline.values()), evaluation, self.config.planner.horizon)

    def save(self, path: Path) -> Path:
        """As a file of :class:`~ls3_torchrl.LS3Agent`."""
        return self.agent.save(path)

    def restore(self, path: Path) -> None:
        """Take the networks of such a file; one of another shape, or with actions in other units, is refused."""
        self.agent.load_state_dict(LS3Agent.load(path, **asdict(self.agent.architecture)).state_dict())

    def draw(
        self,
        folder: Path,
        offline: dict[Tag, TensorDictBase],
        tracks: list[torch.Tensor],
        evaluation: TensorDictBase,
    ) -> None:
        """Reconstructions, timelines, and maps and plans where the states are a plane."""
        agent_pictures.draw_agent(folder, self.config, self.agent, self.policy, offline, evaluation)


def train(config: DictConfig) -> dict:
    """Run the recipe.

    Args:
        config: the resolved configuration of ``conf/ls3.yaml``.

    Returns:
        What is written to ``summary.json``.
    """
    return follow(config, LS3)


@hydra.main(version_base="1.3", config_path="conf", config_name="ls3")
def main(config: DictConfig) -> None:
    """Entry point."""
    train(config)


if __name__ == "__main__":
    main()
