"""What the baselines share: networks, frozen latents or convolutions, batches, cloning, files and pictures."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type
from torchrl.objectives import BCLoss, LossModule
from torchrl.record.loggers import Logger

from ls3_envs import VisualConstraintEnv
from ls3_recipes.algorithms.base import Algorithm, make_agent
from ls3_recipes.algorithms.settings.baselines import BaselineSettings
from ls3_recipes.plots.agent import plot_reconstructions
from ls3_recipes.plots.plane import Field, maps, over_plane, plane_of
from ls3_recipes.plots.style import Pictures
from ls3_torchrl import LS3Agent
from ls3_torchrl.baselines import PixelFeatures, action_bounds
from ls3_torchrl.data import Tag, TaggedReplayBuffer
from ls3_torchrl.files import save_atomically
from ls3_torchrl.trainers import Learner, LearnerGroup, VAETrainer

FORMAT = "ls3_torchrl.comparison"
VERSION = 1
DEMONSTRATIONS = (Tag.SUCCESS,)


class Baseline(Algorithm):
    """Actor, and what it reads: the frozen latents of LS³'s VAE, or images through convolutions of its own."""

    settings: BaselineSettings
    #: Whether :meth:`fields` has any.
    draws_fields = False

    def __init__(self, settings: BaselineSettings, env: TransformedEnv, device: torch.device) -> None:
        self.settings = settings
        self.vae: LS3Agent | None = None
        if settings.encoder == "latents":
            # The networks that LS³ would make: with the same seed, encoder and latents are LS³'s, bit by bit.
            self.vae = make_agent(settings, env, device)
        self.observation = "pixels" if self.vae is None else "loc"
        low, high = action_bounds(env.action_spec)
        self.half = (high - low).to(device) / 2
        with torch.random.fork_rng():  # leaves the VAE's training the random stream that LS³'s has
            self.networks = nn.ModuleDict(self.build(self._builder(env, device)))
        if self.vae is not None:
            assert self.vae.decoder is not None
            self.networks.update({"encoder": self.vae.encoder, "decoder": self.vae.decoder})
        self.policy = self._seeing(self.act())

    def _builder(self, env: TransformedEnv, device: torch.device) -> Callable[..., Any]:
        """What calls a network's constructor with what all of them share."""
        channels = env.observation_spec["pixels"].shape[-3]

        def build(make: Callable[..., Any], **more: Any) -> Any:
            return make(
                env.action_spec,
                PixelFeatures.size if self.vae is None else self.vae.architecture.latent_dim,
                observation_key=self.observation,
                features=PixelFeatures(channels) if self.vae is None else None,
                hidden=tuple(self.settings.policy.hidden),
                **more,
            ).to(device)

        return build

    def build(self, build: Callable[..., Any]) -> dict[str, nn.Module]:
        """The networks by name; one is the ``actor``."""
        raise NotImplementedError

    def act(self) -> TensorDictModuleBase:
        """What acts on observations."""
        return self.networks["actor"]

    def _seeing(self, policy: TensorDictModuleBase) -> TensorDictModuleBase:
        return policy if self.vae is None else TensorDictSequential(self.vae.encoder, policy)

    def begin(
        self, buffer: TaggedReplayBuffer, logger: Logger, horizon: int, after_step: Callable[[], object] | None = None
    ) -> None:
        """Make the learners."""
        self.buffer = buffer
        self.how: dict[str, Any] = {"logger": logger, "after_step": after_step}
        self.vae_trainer = None if self.vae is None else VAETrainer(self.vae, buffer, self.settings.vae, **self.how)
        with torch.random.fork_rng():  # SAC's loss draws numbers, and the VAE is to be LS³'s
            self.learners = LearnerGroup(self.make_learners(horizon))

    def make_learners(self, horizon: int) -> dict[str, Learner]:
        """By name; here the one that clones, ``"cloning"``."""
        with warnings.catch_warnings():  # TorchRL's own class lacks an annotation that TorchRL looks for
            warnings.filterwarnings("ignore", "The name target_actor_network_params wasn't part of the annotations")
            cloning = BCLoss(self.networks["actor"], loss_function=self._distance)
        return {"cloning": self.learner("bc", cloning, lambda: self.sample(DEMONSTRATIONS))}

    def learner(
        self, names: str | list[str], loss: LossModule, sample: Callable[[], TensorDictBase], **how: Any
    ) -> Learner:
        """A learner with the policy's learning rate."""
        return Learner(names, loss, sample, lr=self.settings.policy.lr, **self.how, **how)

    def _distance(self, predicted: Tensor, expert: Tensor) -> Tensor:
        """Squared distances of actions, in units of half their range."""
        return ((predicted - expert) / self.half).square()

    def sample(self, tags: Iterable[Tag]) -> TensorDictBase:
        """A batch of transitions, with images where the networks read them."""
        return self.buffer.sample(self.settings.policy.batch_size, tags=tags, observations=self.vae is None)

    def phases(self) -> dict[str, Callable[[], None]]:
        """The VAE where one is read, and cloning."""
        return ({} if self.vae_trainer is None else {"vae": self.vae_trainer.train}) | {"cloning": self._clone}

    def _clone(self) -> None:
        with set_exploration_type(ExplorationType.DETERMINISTIC):  # the actor's mean
            self.learners.train([("cloning", self.settings.policy.cloning_steps, "Cloning")])

    def update(self) -> None:
        """Nothing is learnt."""

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, lagged networks and counters."""
        vae = self.vae_trainer
        return {
            "networks": self.networks.state_dict(),
            "vae": None if vae is None or vae.finished else vae.state_dict(),
            "learners": self.learners.state_dict(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken."""
        self.networks.load_state_dict(state_dict["networks"])
        if self.vae_trainer is not None:
            if state_dict["vae"] is None:
                self.vae_trainer.finished = True
            else:
                self.vae_trainer.load_state_dict(state_dict["vae"])
        self.learners.load_state_dict(state_dict["learners"])

    def encode(self) -> None:
        """Fill the latents of the buffer again, where networks read latents."""
        if self.vae_trainer is not None:
            self.vae_trainer.encode()

    @property
    def vae_agent(self) -> LS3Agent | None:
        """The networks of which encoder and decoder are read."""
        return self.vae

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
        if not path.is_file():
            raise FileNotFoundError(f"There are no networks at {path}. Pass a file that this algorithm's run wrote.")
        advice = f"{path} holds no networks of {self.name}, or is damaged. Pass a file that this algorithm's run wrote."
        try:
            content = torch.load(path, map_location="cpu", weights_only=True)
        except (EOFError, RuntimeError, KeyError, pickle.UnpicklingError) as error:
            raise ValueError(advice) from error
        wanted = {"format": FORMAT, "version": VERSION, "algorithm": self.name}
        if not isinstance(content, dict) or {key: content.get(key) for key in wanted} != wanted:
            raise ValueError(advice)
        try:
            self.networks.load_state_dict(content["state_dict"])
        except (KeyError, RuntimeError, TypeError) as error:
            raise ValueError(f"The weights in {path} do not fit the run's settings: {error}.") from error

    def fields(self, rows: TensorDictBase) -> dict[str, Field]:
        """What can be drawn over the plane, of rows ``[n]`` with observation and the actor's action."""
        return {}

    def pictures(self, folder: Path, offline: dict[Tag, TensorDictBase], evaluation: TensorDictBase) -> Pictures:
        """Reconstructions of the VAE; value and risk over the plane where the states are one."""
        pictures: Pictures = {}
        if self.vae is not None:
            agent = self.vae
            pictures["reconstructions.png"] = lambda: plot_reconstructions(folder, agent, offline)
        env = plane_of(self.settings.task)
        if env is not None and self.draws_fields:
            pictures["heatmaps.png"] = lambda: self._plot_fields(folder, env, offline)
        return pictures

    @torch.no_grad()
    def _plot_fields(self, folder: Path, env: VisualConstraintEnv, offline: dict[Tag, TensorDictBase]) -> None:
        def act(pixels: Tensor) -> TensorDictBase:
            rows = TensorDict({"pixels": pixels.to(self.half.device)}, [len(pixels)])
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                return self._seeing(self.networks["actor"])(rows)

        maps(folder, env, self.fields(over_plane(env, act)), offline)
