"""What the comparisons share: networks, frozen latents or convolutions, batches, cloning, files and pictures."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type
from torchrl.objectives import BCLoss

import agent_pictures
import pictures
from common import RunFolder
from learning import Learner
from ls3_torchrl import LS3Agent
from ls3_torchrl.baselines import PixelFeatures, action_bounds, gaussian_actor
from ls3_torchrl.data import Tag, TaggedReplayBuffer
from ls3_torchrl.files import save_atomically
from protocol import Algorithm
from representation import train_vae
from settings import agent_options, check_comparison

FORMAT = "ls3_torchrl.comparison"
VERSION = 1
DEMONSTRATIONS = (Tag.SUCCESS,)


class Comparison(Algorithm):
    """Actor, and what it reads: the frozen latents of LS³'s VAE, or images through convolutions of its own."""

    def __init__(self, config: DictConfig, env: TransformedEnv, device: torch.device) -> None:
        check_comparison(config)
        self.config, self.options = config, config.policy
        channels = env.observation_spec["pixels"].shape[-3]
        self.vae: LS3Agent | None = None
        if config.encoder == "latents":
            # The networks that LS³ would make: with the same seed, encoder and latents are LS³'s, bit by bit.
            self.vae = LS3Agent(
                action_dim=env.action_spec.shape[-1], in_channels=channels, **agent_options(config, env.action_spec)
            ).to(device)
        self.observation = "pixels" if self.vae is None else "loc"

        def build(make: Callable[..., Any], **more: Any) -> Any:
            features = PixelFeatures(channels) if self.vae is None else None
            size = PixelFeatures.size if self.vae is None else config.agent.latent_dim
            return make(
                env.action_spec,
                size,
                observation_key=self.observation,
                features=features,
                hidden=tuple(self.options.hidden),
                **more,
            ).to(device)

        low, high = action_bounds(env.action_spec)
        self.half = (high - low).to(device) / 2
        with torch.random.fork_rng():  # leaves the VAE's training the random stream that LS³'s has
            self.networks = nn.ModuleDict(self.build(build))
        if self.vae is not None:
            self.networks.update({"encoder": self.vae.encoder, "decoder": self.vae.decoder})
        self.policy = self._seeing(self.act())

    def build(self, build: Callable[..., Any]) -> dict[str, nn.Module]:
        """The networks by name; one is the ``actor``."""
        return {"actor": build(gaussian_actor, initial_std=self.options.initial_std)}

    def act(self) -> TensorDictModuleBase:
        """What acts on observations."""
        return self.networks["actor"]

    def _seeing(self, policy: TensorDictModuleBase) -> TensorDictModuleBase:
        return policy if self.vae is None else TensorDictSequential(self.vae.encoder, policy)

    def begin(self, buffer: TaggedReplayBuffer, run: RunFolder, horizon: int) -> None:
        """Make the learners."""
        self.buffer, self.run = buffer, run
        self.bonus = 0.0
        self.steps_per_update = round(self.options.updates_per_step * horizon * self.config.online.episodes_per_update)
        with warnings.catch_warnings():  # TorchRL's own class lacks an annotation that TorchRL looks for
            warnings.filterwarnings("ignore", "The name target_actor_network_params wasn't part of the annotations")
            cloning = BCLoss(self.networks["actor"], loss_function=self._distance)
        self.cloning = Learner("bc", cloning, self.rows(DEMONSTRATIONS), lr=self.options.lr)

    def _distance(self, predicted: Tensor, expert: Tensor) -> Tensor:
        """Squared distances of actions, in units of half their range."""
        return ((predicted - expert) / self.half).square()

    def rows(self, tags: Iterable[Tag], *, task_action: bool = False) -> Callable[[], TensorDictBase]:
        """What draws batches: transitions with penalised rewards, and the ends that a critic should know of."""
        options, penalty = self.options, self.options.get("penalty", 0.0)

        def draw() -> TensorDictBase:
            rows = self.buffer.sample(options.batch_size, tags=tags, pixels=self.vae is None)
            if task_action:
                rows.set("action", rows["task_action"])
            reached = rows.get("next")
            violated = reached["constraint"]
            reached.set("reward", reached["reward"] + penalty * violated - self.bonus)
            over = reached["success"] if options.zero_at_goal else torch.zeros_like(violated)
            reached.set("terminated", over)
            reached.set("done", over)
            return rows

        return draw

    def phases(self) -> dict[str, Callable[[], None]]:
        """The VAE where one is read, and cloning."""
        phases: dict[str, Callable[[], None]] = {}
        if self.vae is not None:
            agent = self.vae
            phases["vae"] = lambda: train_vae(agent, self.buffer, self.config, self.run)
        return phases | {"cloning": self._clone}

    def _clone(self) -> None:
        with set_exploration_type(ExplorationType.DETERMINISTIC):  # the actor's mean
            self.cloning.train(self.options.cloning_steps, "Cloning", self.run)

    def train_online(self) -> None:
        """Nothing is learnt."""

    def save(self, path: Path) -> Path:
        """Write the networks' weights."""
        content = {
            "format": FORMAT,
            "version": VERSION,
            "algorithm": self.name,
            "state_dict": self.networks.state_dict(),
        }
        return save_atomically(content, path)

    def restore(self, path: Path) -> None:
        """Take the weights of a file of the same algorithm."""
        content = torch.load(path, map_location="cpu", weights_only=True)
        if content.get("format") != FORMAT or content["version"] != VERSION or content["algorithm"] != self.name:
            raise ValueError(f"{path} holds no networks of {self.name}. Pass a file that this algorithm's run wrote.")
        self.networks.load_state_dict(content["state_dict"])

    def fields(self, rows: TensorDictBase) -> dict[str, pictures.Field]:
        """What can be drawn over the plane, of rows ``[n]`` with observation and the actor's action."""
        return {}

    @torch.no_grad()
    def draw(
        self,
        folder: Path,
        offline: dict[Tag, TensorDictBase],
        tracks: list[Tensor],
        evaluation: TensorDictBase,
    ) -> None:
        """Reconstructions of the VAE; value and risk over the plane where the states are one."""
        if self.vae is not None:
            agent_pictures.reconstructions(folder, self.vae, offline)
        env = pictures.plane_of(self.config)
        if env is None:
            return
        device = self.half.device

        def judge(pixels: Tensor) -> TensorDictBase:
            rows = TensorDict({"pixels": pixels.to(device)}, [len(pixels)])
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                return self._seeing(self.networks["actor"])(rows)

        fields = self.fields(pictures.over_plane(env, judge))
        if fields:
            pictures.maps(folder, env, fields, offline)
