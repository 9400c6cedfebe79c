"""AWAC: an actor that imitates what its critics find better than itself (section 1.1.4)."""

from __future__ import annotations

from collections.abc import Callable

from ls3_recipes.algorithms.actor_critic import ActorCritic
from ls3_recipes.algorithms.settings.baselines import AWACPolicySettings
from ls3_recipes.options import as_dict
from ls3_recipes.plots.style import Label
from ls3_torchrl.baselines import AWACLoss
from ls3_torchrl.data import ALL_TAGS
from ls3_torchrl.trainers import Learner


class AWAC(ActorCritic):
    """Advantage weighted actor-critic, offline on all data, then online."""

    key = name = "awac"
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
