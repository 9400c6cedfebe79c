"""SACfD: soft actor-critic from demonstrations (section 1.1.2), with learnt recovery zones if asked for (1.1.3)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import TransformedEnv
from torchrl.objectives import DDPGLoss, SACLoss

from ls3_recipes.algorithms.actor_critic import ActorCritic
from ls3_recipes.algorithms.baseline import DEMONSTRATIONS
from ls3_recipes.algorithms.settings.baselines import SACfDSettings
from ls3_recipes.options import as_dict
from ls3_recipes.plots.plane import Field
from ls3_recipes.plots.style import Label
from ls3_torchrl.baselines import RecoveryPolicy, SafetyCritic, SafetyCriticLoss, deterministic_actor
from ls3_torchrl.data import ALL_TAGS, Tag, TaggedReplayBuffer
from ls3_torchrl.trainers import Learner, Stage


class SACfD(ActorCritic):
    """Soft actor-critic that starts from an imitating actor and a critic of the demonstrations."""

    key = name = "sacfd"
    labels = {  # noqa: RUF012
        "sacfd_rrl": Label("SACfD+RRL", "#d1495b"),
        "sacfd": Label("SACfD", "#e0a458"),
    }
    settings: SACfDSettings

    def __init__(self, settings: SACfDSettings, env: TransformedEnv, device: torch.device) -> None:
        self.recovery = settings.recovery
        if self.recovery:
            self.name = "sacfd_rrl"
            self.needs = (Tag.SUCCESS, Tag.CONSTRAINT)
        super().__init__(settings, env, device)

    def build(self, build: Callable[..., Any]) -> dict[str, nn.Module]:
        """Actor and critic; with recovery, a safety critic and a policy that keeps its risk low."""
        networks = super().build(build)
        if self.recovery:
            networks |= {"safety_critic": build(SafetyCritic), "recovery": build(deterministic_actor)}
        return networks

    def act(self) -> TensorDictModuleBase:
        """The actor, or whoever acts in its place."""
        if not self.recovery:
            return super().act()
        threshold = self.settings.policy.risk.threshold
        return RecoveryPolicy(super().act(), self.networks["recovery"], self._safety_critic, threshold)

    @property
    def _safety_critic(self) -> SafetyCritic:
        critic = self.networks["safety_critic"]
        assert isinstance(critic, SafetyCritic)
        return critic

    def make_buffer(self, device: torch.device, **labels: Any) -> TaggedReplayBuffer:
        """With recovery, with what the task's policy wanted, in addition to what was done."""
        return super().make_buffer(device, extra_keys=("task_action",) if self.recovery else (), **labels)

    def offline_data(self, offline: dict[Tag, TensorDictBase]) -> dict[Tag, TensorDictBase]:
        """What was done offline was what was wanted."""
        if not self.recovery:
            return offline
        return {tag: episodes.copy().set("task_action", episodes["action"]) for tag, episodes in offline.items()}

    def make_learners(self, horizon: int) -> dict[str, Learner]:
        """With those of the critic alone, of actor and critic, and with recovery of risk and recovery policy."""
        learners = super().make_learners(horizon)
        policy, sac = self.settings.policy, self._sac_loss()
        learners |= {
            "critic": self.learner("qvalue", sac, lambda: self.sample(DEMONSTRATIONS), tau=policy.tau),
            "both": self.learner(["actor", "qvalue"], sac, self._sample_wanted, tau=policy.tau),
        }
        return learners | (self._recovery_learners() if self.recovery else {})

    def _sac_loss(self) -> SACLoss:
        policy, gamma = self.settings.policy, as_dict(self.settings.buffer)["gamma"]
        # In the actions' own units entropies lie this much above those in units of half the box. Without a correction,
        # every step would be rewarded for the units that the actions are measured in.
        self.bonus = gamma * policy.alpha * float(self.half.log().sum())
        loss = SACLoss(
            self.networks["actor"],
            self.networks["critic"],
            loss_function="l2",
            alpha_init=policy.alpha,
            fixed_alpha=True,
            target_entropy=0.0,  # TorchRL wants one, which nothing is learnt from
        )
        loss.make_value_estimator(gamma=gamma)
        return loss

    def _recovery_learners(self) -> dict[str, Learner]:
        policy = self.settings.policy
        risk = SafetyCriticLoss(self._safety_critic, super().act(), gamma=policy.risk.gamma)
        safer = DDPGLoss(self.networks["recovery"], self.networks["safety_critic"], delay_value=False)
        safer.set_keys(state_action_value="safety")
        safer.make_value_estimator(gamma=policy.risk.gamma)
        return {
            "risk": self.learner("safety", risk, lambda: self.sample(ALL_TAGS), tau=policy.tau),
            "safer": self.learner("actor", safer, lambda: self.sample(ALL_TAGS)),
        }

    def _sample_wanted(self) -> TensorDictBase:
        """Of demonstrations and online episodes; with recovery, with the actions that the task's policy wanted."""
        rows = self.sample((*DEMONSTRATIONS, Tag.ONLINE))
        return rows.set("action", rows["task_action"]) if self.recovery else rows

    def phases(self) -> dict[str, Callable[[], None]]:
        """Cloning, the critic of the demonstrations, and with recovery the risk in all data."""
        policy = self.settings.policy
        critic = ("critic", policy.critic_steps, "Critic")
        phases = super().phases() | {"critic": lambda: self.learners.train([critic])}
        if self.recovery:
            phases["risk"] = lambda: self.learners.train(self._risk_stages(policy.risk.offline_steps))
        return phases

    def _risk_stages(self, steps: int) -> list[Stage]:
        return [("risk", steps, "Safety critic"), ("safer", steps, "Recovery policy")]

    def stages(self) -> list[Stage]:
        """Actor and critic, from demonstrations and online episodes; with recovery, risk from all data."""
        return super().stages() + (self._risk_stages(self.steps_per_update) if self.recovery else [])

    def describe(self, episodes: TensorDictBase) -> dict[str, float]:
        """How often the recovery policy took over."""
        return {"recovery_rate": float(episodes["recovered"].float().mean())} if self.recovery else {}

    def fields(self, rows: TensorDictBase) -> dict[str, Field]:
        """The critic's value of what the actor would do, and its risk."""
        fields = super().fields(rows)
        if self.recovery:
            level = self.settings.policy.risk.threshold
            risk = self._safety_critic(rows)["risk"].flatten()
            fields["Risk $Q_{risk}$"] = Field(risk, "OrRd", limits=(0.0, 1.0), level=level)
        return fields
