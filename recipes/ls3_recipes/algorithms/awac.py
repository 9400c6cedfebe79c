"""AWAC: an actor that imitates what its critics find better than itself (section 1.1.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ls3_recipes.algorithms.actor_critic import ActorCritic
from ls3_recipes.algorithms.baseline import ActorCriticSettings, BaselineSettings
from ls3_recipes.options import as_dict
from ls3_recipes.plots.style import Label
from ls3_torchrl._checks import require_positive
from ls3_torchrl.baselines import AWACLoss
from ls3_torchrl.data import ALL_TAGS
from ls3_torchrl.trainers import Learner


@dataclass(frozen=True, kw_only=True)
class AWACPolicySettings(ActorCriticSettings):
    """Actor and critic, with the authors' values.

    Faster critics diverge here: they also learn from violating data, whose actions are not the actor's.

    Args:
        temperature: by which advantages are divided before they weigh what is imitated; above 0.
    """

    tau: float = 0.005
    updates_per_step: float = 1.0
    cloning_steps: int = 0
    temperature: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what would only fail after time was spent."""
        super().__post_init__()
        require_positive(self.temperature, "temperature")


@dataclass(frozen=True, kw_only=True)
class AWACSettings(BaselineSettings):
    """What a run of AWAC has."""

    policy: AWACPolicySettings


class AWAC(ActorCritic):
    """Advantage weighted actor-critic, offline on all data, then online."""

    key = name = "awac"
    settings_class = AWACSettings
    labels = {"awac": Label("AWAC", "#5b6fb5")}  # noqa: RUF012

    def make_learners(self, horizon: int) -> dict[str, Learner]:
        """With that of actor and critic."""
        policy = self.settings.policy
        assert isinstance(policy, AWACPolicySettings)
        learners = super().make_learners(horizon)
        loss = AWACLoss(self.networks["actor"], self.networks["critic"], temperature=policy.temperature)
        loss.make_value_estimator(gamma=as_dict(self.settings.buffer)["gamma"])
        both = self.learner(["actor", "qvalue"], loss, lambda: self.sample(ALL_TAGS), tau=policy.tau)
        return learners | {"both": both}

    def phases(self) -> dict[str, Callable[[], None]]:
        """Actor and critic together, on all offline data."""
        stage = ("both", self.options.critic_steps, "Actor and critic")
        return super().phases() | {"critic": lambda: self.learners.train([stage])}
