"""LS³ under the protocol: the VAE, the latent models, and the planner that acts by them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded
from torchrl.envs import TransformedEnv
from torchrl.record.loggers import Logger

from ls3_recipes.algorithms.base import Algorithm, make_agent
from ls3_recipes.figures import as_one_shape
from ls3_recipes.options import as_dict, errors_of, from_signatures
from ls3_recipes.plots.agent import pictures_of_agent
from ls3_recipes.plots.style import Label, Pictures
from ls3_recipes.run_settings import EpisodeSettings, RunSettings, check_buffer, require_within
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, TaggedReplayBuffer
from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator, SafeSet, ValueEnsemble
from ls3_torchrl.planners import CrossEntropyMethod, LatentEnv, LS3Planner, describe_plan
from ls3_torchrl.trainers import (
    LossOptions,
    LS3Options,
    LS3Trainer,
    OfflineOptions,
    OnlineOptions,
    OptimOptions,
    StateProbe,
    VAETrainer,
)


@dataclass(frozen=True, kw_only=True)
class OnlineSettings(EpisodeSettings, OnlineOptions):
    """The episodes of online improvement, and the gradient steps of each update."""

    def __post_init__(self) -> None:
        """Check both."""
        EpisodeSettings.__post_init__(self)
        OnlineOptions.__post_init__(self)


BufferSettings = from_signatures(
    "BufferSettings",
    "The arguments of :class:`~ls3_torchrl.data.TaggedReplayBuffer` that matter to LS³.",
    TaggedReplayBuffer,
    only=("capacity", "gamma", "success_tail", "dynamics_after_violation", "continue_failures"),
    check=check_buffer,
)


@cache
def _smallest_model() -> tuple[LatentEnv, ValueEnsemble, SafeSet]:
    """Something to plan with, for no other purpose than to have a planner's settings checked."""
    with torch.random.fork_rng(devices=[]):
        spec, hidden = Bounded(low=-1.0, high=1.0, shape=(1,)), (1,)
        dynamics = EnsembleDynamics(1, 1, num_members=1, hidden=hidden)
        heads = ConstraintEstimator(1, hidden=hidden), GoalEstimator(1, hidden=hidden)
        model = LatentEnv(dynamics, *heads, action_spec=spec)
        return model, ValueEnsemble(1, num_members=1, hidden=hidden), SafeSet(1, hidden=hidden)


PlannerSettings = from_signatures(
    "PlannerSettings",
    "The options of :class:`~ls3_torchrl.planners.LS3Planner` and of the cross-entropy method.",
    LS3Planner,
    CrossEntropyMethod,
    check=lambda **settings: LS3Planner(*_smallest_model(), **settings),
)


@dataclass(frozen=True, kw_only=True)
class LS3Settings(RunSettings):
    """What a run of LS³ has, in addition to what every run has."""

    buffer: BufferSettings  # type: ignore[valid-type]
    online: OnlineSettings
    offline: OfflineOptions
    optim: OptimOptions
    loss: LossOptions
    planner: PlannerSettings  # type: ignore[valid-type]

    def __post_init__(self) -> None:
        """Refuse what only the sections together are wrong in."""
        super().__post_init__()
        if as_dict(self.buffer)["continue_failures"] and as_dict(self.buffer)["gamma"] == 1.0:
            raise ValueError(
                "buffer.gamma must be below 1 with buffer.continue_failures=true, got 1.0: a failure that goes on for "
                "ever would return minus infinity. Lower it, for example to 0.99, or set "
                "buffer.continue_failures=false and loss.monte_carlo=false."
            )
        if self.loss.monte_carlo and not as_dict(self.buffer)["continue_failures"]:
            raise ValueError(
                "loss.monte_carlo needs buffer.continue_failures=true: otherwise a failure's return ends with the "
                "horizon and is no lower bound."
            )

    def require_horizon(self, steps: int) -> None:
        """Raise ``ValueError`` for a setting that does not fit episodes of so many steps."""
        super().require_horizon(steps)
        require_within(self.loss.dynamics_horizon, steps, "loss.dynamics_horizon")
        require_within(as_dict(self.planner)["horizon"], steps, "planner.horizon")

    @property
    def training(self) -> LS3Options:
        """The settings of the latent models' training."""
        return LS3Options(offline=self.offline, online=self.online, optim=self.optim, loss=self.loss)


class LS3(Algorithm):
    """VAE, latent models and planner, in the paper's order."""

    key = name = "ls3"
    settings_class = LS3Settings
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
        self.trainer = LS3Trainer(self.agent, buffer, self.settings.training, episode_length=horizon, **how)

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

    def save(self, path: Path) -> Path:
        """As a file of :class:`~ls3_torchrl.LS3Agent`."""
        return self.agent.save(path)

    def restore(self, path: Path) -> None:
        """Take the networks of such a file; one of another shape, or with actions in other units, is refused."""
        self.agent.load_state_dict(LS3Agent.load(path, **asdict(self.agent.architecture)).state_dict())

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
