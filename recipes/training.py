"""The phases of LS³'s learning after the VAE: offline models, online updates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase

from common import RunFolder
from learning import AuxiliaryLoss, Learner, wants_bf16
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import ALL_TAGS, VALUE_TAGS, Tag, TaggedReplayBuffer
from ls3_torchrl.objectives import (
    ClassifierLoss,
    EnsembleDynamicsLoss,
    OfflineValueLoss,
    SafeSetLoss,
    TD1ValueLoss,
)


class Training:
    """All learners of an agent on one buffer, and the phases in the paper's order.

    Args:
        agent: its networks are trained in place.
        buffer: filled with the offline data.
        config: the recipe's configuration.
        run: where metrics go.
        horizon: steps in an episode.
    """

    def __init__(
        self, agent: LS3Agent, buffer: TaggedReplayBuffer, config: DictConfig, run: RunFolder, *, horizon: int = 100
    ) -> None:
        self.agent, self.buffer, self.config, self.run, self.horizon = agent, buffer, config, run, horizon
        optim, loss = config.optim, config.loss
        batch, interval, bootstrap = optim.batch_size, optim.target_interval, optim.bootstrap
        self._left_out = None if loss.frozen_dynamics else "after_violation"

        def draw(tags: tuple, members: int | None = None, **options: Any) -> Callable[[], TensorDictBase]:
            options |= {
                "tags": tags,
                "members": members if bootstrap else None,
                "online_fraction": config.online.fraction,
            }
            return lambda: buffer.sample(batch, **options)

        everything = draw(ALL_TAGS)

        how: dict[str, Any] = {
            "bf16": wants_bf16(optim.autocast, next(agent.parameters()).device),
            "cooldown": optim.cooldown,
        }
        members, values = agent.dynamics.num_members, agent.value.num_members
        goal = ClassifierLoss(agent.goal, name="goal")
        goal.set_keys(label=("next", "success"))
        td1: dict[str, Any] = {
            "gamma": loss.gamma,
            "zero_at_goal": loss.zero_at_goal,
            "monte_carlo": loss.monte_carlo,
            "bootstrap": bootstrap,
        }
        self.dynamics = Learner(
            "dynamics",
            EnsembleDynamicsLoss(agent.dynamics, bootstrap=bootstrap, steps=loss.dynamics_horizon),
            draw(
                ALL_TAGS,
                members,
                without=self._left_out,
                steps=loss.dynamics_horizon if loss.dynamics_horizon > 1 else None,
            ),
            lr=optim.dynamics_lr,
            **how,
        )
        failures = None
        if loss.failure_weight > 0.0:
            failures = AuxiliaryLoss(
                loss.failure_weight, OfflineValueLoss(agent.value, bootstrap=bootstrap), self._failures
            )
        self.value = Learner(
            "value",
            OfflineValueLoss(agent.value, bootstrap=bootstrap),
            draw(VALUE_TAGS, values),
            lr=optim.lr,
            **how,
            auxiliary=failures,
        )
        self.value_td = Learner(
            "value",
            TD1ValueLoss(agent.value, **td1),
            draw(VALUE_TAGS, values),
            lr=optim.lr,
            **how,
            target_interval=interval,
        )
        self.safe_set = Learner(
            "safe_set",
            SafeSetLoss(agent.safe_set, gamma=loss.gamma_safe_set),
            lambda: self._weighed(everything()),
            lr=optim.lr,
            **how,
            target_interval=interval,
        )
        self.constraint = Learner("constraint", ClassifierLoss(agent.constraint), everything, lr=optim.lr, **how)
        self.goal = Learner("goal", goal, everything, lr=optim.lr, **how)
        for name in loss.mean_latents:
            keys = {"latent": "loc", "next_latent": ("next", "loc")}
            getattr(self, name).loss.set_keys(**(keys if name == "dynamics" else {"latent": ("next", "loc")}))

    def _failures(self) -> TensorDictBase:
        """States of the violating demonstrations, labelled with the value of failure."""
        optim = self.config.optim
        members = self.agent.value.num_members if optim.bootstrap else 1
        count = max(optim.batch_size // 4, 1) * members
        rows = self.buffer.sample(count, tags=[Tag.CONSTRAINT])
        if self.config.loss.failure_rows == "violating":
            found = rows["next", "constraint"].flatten().nonzero().flatten()
            if len(found):
                # Those that were found stand in for the others: the batch keeps its size.
                rows = rows[found[torch.arange(count, device=found.device) % len(found)]]
                rows.set("latent", rows["next", "latent"])
        rows = rows.reshape(-1, members) if optim.bootstrap else rows
        loss, horizon = self.config.loss, self.horizon
        value = loss.failure_value
        if value is None:
            value = -(1.0 - loss.gamma**horizon) / (1.0 - loss.gamma) if loss.gamma < 1.0 else -float(horizon)
        return rows.set("reward_to_go", torch.full_like(rows["reward_to_go"], value))

    def _weighed(self, rows: TensorDictBase) -> TensorDictBase:
        """The rows for equation (5); how much those of undecided online episodes count is a setting."""
        weight = self.config.loss.timed_out_weight
        if weight != 1.0:
            timed_out = rows["timed_out"] & (rows["tag"] == int(Tag.ONLINE))
            rows.set("safe_set_weight", torch.where(timed_out, weight, 1.0))
        return rows

    def train_offline(self) -> None:
        """Train the latent models on the offline data (equations (2), (3), (4), (5) and the classifiers)."""
        steps = self.config.offline
        self.dynamics.train(steps.dynamics_steps, "Dynamics", self.run)
        self.value.train(steps.value_steps, "Value, reward-to-go", self.run)
        self.value_td.train(steps.value_td_steps, "Value, TD-1", self.run)
        self._train_classifiers(steps.classifier_steps)

    def train_online(self) -> None:
        """One update on all data, after new episodes."""
        steps = self.config.online
        self.dynamics.train(steps.dynamics_steps, "Dynamics", self.run)
        self.value_td.train(steps.value_td_steps, "Value, TD-1", self.run)
        self._train_classifiers(steps.classifier_steps)

    def _train_classifiers(self, steps: int) -> None:
        self.safe_set.train(steps, "Safe set", self.run)
        self.constraint.train(steps, "Constraint", self.run)
        self.goal.train(steps, "Goal", self.run)
