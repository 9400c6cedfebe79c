"""What SACfD and AWAC share: an actor, a critic of penalised rewards, and updates in step with the environment."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import SACLoss

from ls3_recipes.algorithms.baseline import Baseline
from ls3_recipes.algorithms.settings.baselines import ActorCriticSettings
from ls3_recipes.plots.plane import Field
from ls3_torchrl.baselines import action_value, gaussian_actor
from ls3_torchrl.data import Tag
from ls3_torchrl.trainers import Learner, Stage


class ActorCritic(Baseline):
    """A stochastic actor with a critic."""

    draws_fields = True
    #: Taken off every reward.
    bonus = 0.0

    @property
    def options(self) -> ActorCriticSettings:
        """The policy's settings."""
        assert isinstance(self.settings.policy, ActorCriticSettings)
        return self.settings.policy

    def build(self, build: Callable[..., Any]) -> dict[str, nn.Module]:
        """Actor and critic."""
        return {"actor": build(gaussian_actor, initial_std=self.options.initial_std), "critic": build(action_value)}

    def make_learners(self, horizon: int) -> dict[str, Learner]:
        """With the one that trains actor and critic together, ``"both"``."""
        self.steps_per_update = round(
            self.options.updates_per_step * horizon * self.settings.online.episodes_per_update
        )
        return super().make_learners(horizon)

    def sample(self, tags: Iterable[Tag]) -> TensorDictBase:
        """Transitions with penalised rewards, none of which ends the task: neither goal nor violation does."""
        rows = super().sample(tags)
        reached = rows.get("next")
        violated = reached["constraint"]
        reached.set("reward", reached["reward"] + self.options.penalty * violated - self.bonus)
        over = torch.zeros_like(violated)
        reached.set("terminated", over)
        reached.set("done", over)
        return rows

    def stages(self) -> list[Stage]:
        """What an update trains: actor and critic together."""
        return [("both", self.steps_per_update, "Actor and critic")]

    def update(self) -> None:
        """Learn from all data that the algorithm learns from."""
        self.learners.train(self.stages())

    def fields(self, rows: TensorDictBase) -> dict[str, Field]:
        """The critic's value of what the actor would do."""
        return {"Value min Q": Field(least_value(self.learners.learners["both"].loss, rows), "viridis")}


def least_value(loss: SACLoss, rows: TensorDictBase) -> Tensor:
    """min_i Q_i(s, a) of rows ``[n]``."""
    values = []
    for params in loss.qvalue_network_params.unbind(0):
        with params.to_module(loss.qvalue_network):
            values.append(loss.qvalue_network(rows.copy())["state_action_value"].flatten())
    return torch.stack(values).amin(0)
