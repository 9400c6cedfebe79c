"""What can be set of LS³."""

from __future__ import annotations

from dataclasses import dataclass

from ls3_recipes.run_settings import EpisodeSettings, RunSettings, require_within
from ls3_torchrl.options.planner import PlannerOptions
from ls3_torchrl.options.training import LossOptions, LS3Options, OfflineOptions, OnlineOptions, OptimOptions


@dataclass(frozen=True, kw_only=True)
class OnlineSettings(EpisodeSettings, OnlineOptions):
    """The episodes of online improvement, and the gradient steps of each update."""

    def __post_init__(self) -> None:
        """Check both."""
        EpisodeSettings.__post_init__(self)
        OnlineOptions.__post_init__(self)


@dataclass(frozen=True, kw_only=True)
class LS3Settings(RunSettings):
    """What a run of LS³ has, in addition to what every run has."""

    online: OnlineSettings
    offline: OfflineOptions
    optim: OptimOptions
    loss: LossOptions
    planner: PlannerOptions

    def require_horizon(self, steps: int) -> None:
        """Raise ``ValueError`` for a setting that does not fit episodes of so many steps."""
        super().require_horizon(steps)
        require_within(self.loss.dynamics_horizon, steps, "loss.dynamics_horizon")
        require_within(self.planner.horizon, steps, "planner.horizon")

    @property
    def training(self) -> LS3Options:
        """The settings of the latent models' training."""
        return LS3Options(offline=self.offline, online=self.online, optim=self.optim, loss=self.loss)
