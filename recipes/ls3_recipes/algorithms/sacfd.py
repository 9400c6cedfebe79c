"""The comparisons: behaviour cloning, SACfD with or without recovery, and AWAC (sections 1.1.2 to 1.1.4)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import TransformedEnv
from torchrl.objectives import DDPGLoss, SACLoss

import pictures
from common import RunFolder
from comparison import DEMONSTRATIONS, Comparison
from learning import Learner
from ls3_torchrl.baselines import (
    AWACLoss,
    RecoveryPolicy,
    SafetyCritic,
    SafetyCriticLoss,
    action_value,
    deterministic_actor,
)
from ls3_torchrl.data import ALL_TAGS, Tag, TaggedReplayBuffer
from protocol import follow


class BehaviourCloning(Comparison):
    """The floor: the demonstrations imitated."""

    name = "bc"

    def build(self, build: Callable[..., Any]) -> dict[str, nn.Module]:
        """An actor without noise."""
        return {"actor": build(deterministic_actor)}


class SACfD(Comparison):
    """Soft actor-critic that starts from an imitating actor and a critic of the demonstrations."""

    name = "sacfd"

    def __init__(self, config: DictConfig, env: TransformedEnv, device: torch.device) -> None:
        self.recovery = bool(config.recovery)
        if self.recovery:
            self.name = "sacfd_rrl"
            self.needs = (Tag.SUCCESS, Tag.CONSTRAINT)
        super().__init__(config, env, device)

    def build(self, build: Callable[..., Any]) -> dict[str, nn.Module]:
        """Actor and critic; with recovery, a safety critic and a policy that keeps its risk low."""
        networks = super().build(build) | {"critic": build(action_value)}
        if self.recovery:
            networks |= {"safety_critic": build(SafetyCritic), "recovery": build(deterministic_actor)}
        return networks

    def act(self) -> TensorDictModuleBase:
        """The actor, or whoever acts in its place."""
        if not self.recovery:
            return super().act()
        return RecoveryPolicy(
            super().act(), self.networks["recovery"], self._safety_critic(), self.options.risk.threshold
        )

    def _safety_critic(self) -> SafetyCritic:
        critic = self.networks["safety_critic"]
        assert isinstance(critic, SafetyCritic)
        return critic

    def make_buffer(self, device: torch.device, **labels: Any) -> TaggedReplayBuffer:
        """With recovery, with what the task's policy wanted, beside what was done."""
        return super().make_buffer(device, extra_keys=("task_action",) if self.recovery else (), **labels)

    def offline_data(self, offline: dict[Tag, TensorDictBase]) -> dict[Tag, TensorDictBase]:
        """What was done offline was what was wanted."""
        if not self.recovery:
            return offline
        return {tag: episodes.copy().set("task_action", episodes["action"]) for tag, episodes in offline.items()}

    def begin(self, buffer: TaggedReplayBuffer, run: RunFolder, horizon: int) -> None:
        """Make the learners."""
        super().begin(buffer, run, horizon)
        options, gamma = self.options, self.config.loss.gamma
        # In the actions' own units entropies lie this much above those in units of half the box. Without a correction,
        # every step would be rewarded for the units that the actions are measured in.
        offset = float(self.half.log().sum())
        if not options.learn_alpha:
            self.bonus = gamma * options.alpha * offset
        sac = SACLoss(
            self.networks["actor"],
            self.networks["critic"],
            loss_function="l2",
            alpha_init=options.alpha,
            fixed_alpha=not options.learn_alpha,
            target_entropy=offset - float(len(self.half)),
        )
        sac.make_value_estimator(gamma=gamma)
        how = {"lr": options.lr, "tau": options.tau}
        seen = (*DEMONSTRATIONS, Tag.ONLINE)
        self.critic = Learner("qvalue", sac, self.rows(DEMONSTRATIONS), **how)
        names = ["actor", "qvalue", *(["alpha"] if options.learn_alpha else [])]
        self.both = Learner(names, sac, self.rows(seen, task_action=self.recovery), **how)
        if not self.recovery:
            return
        risk = SafetyCriticLoss(self._safety_critic(), super().act(), gamma=options.risk.gamma)
        self.risk = Learner("safety", risk, self.rows(ALL_TAGS), **how)
        safer = DDPGLoss(self.networks["recovery"], self.networks["safety_critic"], delay_value=False)
        safer.set_keys(state_action_value="safety")
        safer.make_value_estimator(gamma=options.risk.gamma)
        self.safer = Learner("actor", safer, self.rows(ALL_TAGS), lr=options.lr)

    def phases(self) -> dict[str, Callable[[], None]]:
        """Cloning, the critic of the demonstrations, and with recovery the risk in all data."""
        phases = super().phases() | {"critic": lambda: self.critic.train(self.options.critic_steps, "Critic", self.run)}
        if self.recovery:
            phases["risk"] = lambda: self._train_risk(self.options.risk.offline_steps)
        return phases

    def _train_risk(self, steps: int) -> None:
        self.risk.train(steps, "Safety critic", self.run)
        self.safer.train(steps, "Recovery policy", self.run)

    def train_online(self) -> None:
        """Actor and critic, from demonstrations and online episodes; risk from all data."""
        self.both.train(self.steps_per_update, "Actor and critic", self.run)
        if self.recovery:
            self._train_risk(self.steps_per_update)

    def describe(self, episodes: TensorDictBase) -> dict[str, float]:
        """How often the recovery policy took over."""
        return {"recovery_rate": float(episodes["recovered"].float().mean())} if self.recovery else {}

    def fields(self, rows: TensorDictBase) -> dict[str, pictures.Field]:
        """The critic's value of what the actor would do, and its risk."""
        fields = {"Value min Q": pictures.Field(least_value(self.both.loss, rows), "viridis")}
        if self.recovery:
            risk = self._safety_critic()(rows)["risk"].flatten()
            level = self.options.risk.threshold
            fields["Risk $Q_{risk}$"] = pictures.Field(risk, "OrRd", limits=(0.0, 1.0), level=level)
        return fields


class AWAC(Comparison):
    """Advantage weighted actor-critic."""

    name = "awac"

    def build(self, build: Callable[..., Any]) -> dict[str, nn.Module]:
        """Actor and critic."""
        return super().build(build) | {"critic": build(action_value)}

    def begin(self, buffer: TaggedReplayBuffer, run: RunFolder, horizon: int) -> None:
        """Make the learners."""
        super().begin(buffer, run, horizon)
        options = self.options
        awac = AWACLoss(self.networks["actor"], self.networks["critic"], temperature=options.temperature)
        awac.make_value_estimator(gamma=self.config.loss.gamma)
        self.both = Learner(["actor", "qvalue"], awac, self.rows(ALL_TAGS), lr=options.lr, tau=options.tau)

    def phases(self) -> dict[str, Callable[[], None]]:
        """Actor and critic together, on all offline data."""
        return super().phases() | {
            "critic": lambda: self.both.train(self.options.critic_steps, "Actor and critic", self.run)
        }

    def train_online(self) -> None:
        """Actor and critic, from all data."""
        self.both.train(self.steps_per_update, "Actor and critic", self.run)

    def fields(self, rows: TensorDictBase) -> dict[str, pictures.Field]:
        """The critic's value of what the actor would do."""
        return {"Value min Q": pictures.Field(least_value(self.both.loss, rows), "viridis")}


def least_value(loss: SACLoss, rows: TensorDictBase) -> Tensor:
    """min_i Q_i(s, a) of rows ``[n]``."""
    values = []
    for params in loss.qvalue_network_params.unbind(0):
        with params.to_module(loss.qvalue_network):
            values.append(loss.qvalue_network(rows.copy())["state_action_value"].flatten())
    return torch.stack(values).amin(0)


def relevant(config: DictConfig) -> DictConfig:
    """The settings that a comparison has, without those of LS³ alone that a preset brings along."""
    alone = {"planner", "offline", "optim", "loss", "online"}
    kept = OmegaConf.masked_copy(config, [str(key) for key in config if str(key) not in alone])
    for group, names in (
        ("loss", ("gamma", "success_tail", "frozen_dynamics")),
        ("online", ("updates", "episodes_per_update", "select")),
    ):
        OmegaConf.update(kept, group, OmegaConf.masked_copy(config[group], list(names)), force_add=True)
    return kept


def train(config: DictConfig) -> dict:
    """Run a comparison's recipe.

    Args:
        config: the resolved configuration of ``conf/bc.yaml``, ``conf/sacfd.yaml`` or ``conf/awac.yaml``.

    Returns:
        What is written to ``summary.json``.
    """
    return follow(relevant(config), COMPARISONS[config.algorithm])


COMPARISONS: dict[str, type[Comparison]] = {"bc": BehaviourCloning, "sacfd": SACfD, "awac": AWAC}
