"""What the protocol asks of an algorithm."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv
from torchrl.record.loggers import Logger

from ls3_recipes.options import as_dict, errors_of
from ls3_recipes.plots.style import Label, Pictures
from ls3_recipes.run_settings import RunSettings
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, TaggedReplayBuffer


class Algorithm(ABC):
    """What learns and acts under the protocol.

    Everything that can be wrong with the settings is found in the constructor, before time is spent.

    Args:
        settings: of the class that stands beside it in the table of algorithms.
        env: the environment that it will act in.
        device: of its networks.
    """

    #: As in the configuration's ``algorithm``.
    key: ClassVar[str]
    #: How reports show it, by :attr:`name`.
    labels: ClassVar[Mapping[str, Label]]

    settings: RunSettings
    #: As in ``summary.json``; the key, unless a setting makes another algorithm of it.
    name: str
    #: Tags of the offline data that it cannot do without.
    needs: tuple[Tag, ...] = (Tag.SUCCESS,)
    #: What acts; writes ``action``.
    policy: TensorDictModuleBase

    @abstractmethod
    def __init__(self, settings: Any, env: TransformedEnv, device: torch.device) -> None: ...

    def prepare(self, env: TransformedEnv) -> None:  # noqa: B027
        """Append what the policy needs of an environment."""

    def offline_data(self, offline: dict[Tag, TensorDictBase]) -> dict[Tag, TensorDictBase]:
        """The offline episodes as the buffer takes them."""
        return offline

    def make_buffer(self, device: torch.device, **labels: Any) -> TaggedReplayBuffer:
        """An empty buffer; ``labels`` are options of its own about what is kept of an episode."""
        settings = self.settings
        options = as_dict(settings.buffer)
        with errors_of("buffer", options):
            return TaggedReplayBuffer(
                **options,
                **labels,
                latent_dim=as_dict(settings.agent)["latent_dim"],
                scratch_dir=settings.scratch_dir,
                device=device,
            )

    @abstractmethod
    def begin(
        self, buffer: TaggedReplayBuffer, logger: Logger, horizon: int, after_step: Callable[[], object] | None = None
    ) -> None:
        """Make the learners, on a buffer that holds the offline data; ``after_step`` follows every gradient step."""

    @abstractmethod
    def phases(self) -> dict[str, Callable[[], None]]:
        """What is trained offline: the phases' names, and what carries them out, in their order."""

    @abstractmethod
    def update(self) -> None:
        """Learn from all data, after new episodes."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, lagged networks and counters, in the middle of a phase or of an update as well."""

    @abstractmethod
    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken: the phase or update that was cut is to be called again."""

    @abstractmethod
    def encode(self) -> None:
        """Fill the latents of the buffer again, as the VAE's training had done."""

    def describe(self, episodes: TensorDictBase) -> dict[str, float]:
        """Figures of the policy's own about episodes that it acted in, for the metrics."""
        return {}

    def diagnose(self, offline: dict[Tag, TensorDictBase], evaluation: TensorDictBase) -> dict[str, float]:
        """Figures about what it has learnt, for the summary."""
        return {}

    @property
    def vae_agent(self) -> LS3Agent | None:
        """The networks of which the VAE is one; ``None`` where nothing reads latents."""
        return None

    @abstractmethod
    def save(self, path: Path) -> Path:
        """Write all networks to one file."""

    @abstractmethod
    def restore(self, path: Path) -> None:
        """Take the networks of a file."""

    def pictures(self, folder: Path, offline: dict[Tag, TensorDictBase], evaluation: TensorDictBase) -> Pictures:
        """What draws pictures of its own into a folder, in addition to those that every run leaves."""
        return {}


def make_agent(
    settings: RunSettings, env: TransformedEnv, device: torch.device, *, planner: Mapping[str, Any] | None = None
) -> LS3Agent:
    """LS³'s networks for an environment; with the same seed the same ones, whoever reads their latents."""
    options = as_dict(settings.agent)
    with errors_of("agent", options):
        return LS3Agent(
            action_spec=env.action_spec,
            planner=planner,
            task=settings.task.name,
            in_channels=env.observation_spec["pixels"].shape[-3],
            **options,
        ).to(device)
