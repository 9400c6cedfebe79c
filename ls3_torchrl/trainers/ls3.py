"""LS3Trainer: the latent models are trained offline, then updated as episodes come (section 1.1.1)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.record.loggers import Logger

from ls3_torchrl.agent import LS3Agent
from ls3_torchrl.data import VALUE_TAGS, BatchStream, RowSelection, Tag, TaggedReplayBuffer
from ls3_torchrl.objectives import (
    ClassifierLoss,
    EnsembleDynamicsLoss,
    OfflineValueLoss,
    SafeSetLoss,
    TD1ValueLoss,
)
from ls3_torchrl.objectives.base import LatentLoss
from ls3_torchrl.options.training import LS3Options
from ls3_torchrl.trainers.checks import require_actions_of, warn_of_missing_outcomes
from ls3_torchrl.trainers.group import LearnerGroup, Stage
from ls3_torchrl.trainers.learner import Learner
from ls3_torchrl.trainers.steps import wants_bf16

#: The learners in the order in which they are trained.
LEARNERS = ("dynamics", "value", "value_td", "safe_set", "constraint", "goal")


class LS3Trainer:
    """All learners of an agent on one buffer, in the paper's order: equations (2), (3), (4), (5), constraint and goal.

    Args:
        agent: its networks are trained in place.
        buffer: filled with the offline data and encoded (:class:`~ls3_torchrl.trainers.VAETrainer`, or
            ``buffer.encode``); its γ is that of equations (3) and (4).
        options: how.
        logger: one of TorchRL's; gets every metric as ``phase/name``.
        progress: show progress bars.
        after_step: called after every gradient step; see :class:`~ls3_torchrl.trainers.Learner`.

    Raises:
        ValueError: for options that do not fit the buffer's.
        DivergenceError: by training, when a loss or a gradient is not finite.

    Example:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from ls3_torchrl.trainers import OfflineOptions, OptimOptions
        >>> encoder = TensorDictModule(torch.nn.Identity(), ["pixels"], ["latent"])  # states are latents already
        >>> agent = LS3Agent(action_dim=2, encoder=encoder, latent_dim=4)
        >>> step = {"reward": -torch.ones(9, 1), "pixels": torch.randn(9, 4)}
        >>> step |= {k: torch.ones(9, 1, dtype=torch.bool) for k in ("constraint", "success")}
        >>> episode = TensorDict({"pixels": torch.randn(9, 4), "action": torch.zeros(9, 2), "next": step}, [9])
        >>> buffer = TaggedReplayBuffer(capacity=100, latent_dim=4)
        >>> buffer.add(episode, "success")
        >>> buffer.encode(agent.encoder)
        >>> options = LS3Options(offline=OfflineOptions(2, 2, 2), optim=OptimOptions(batch_size=8))
        >>> trainer = LS3Trainer(agent, buffer, options, progress=False)
        >>> trainer.train_offline()
        >>> trainer.dynamics.steps
        2
    """

    def __init__(
        self,
        agent: LS3Agent,
        buffer: TaggedReplayBuffer,
        options: LS3Options | None = None,
        *,
        logger: Logger | None = None,
        progress: bool = True,
        after_step: Callable[[], object] | None = None,
    ) -> None:
        self.agent, self.buffer = agent, buffer
        self.options = options = LS3Options() if options is None else options
        if agent.architecture.latent_dim != buffer.latent_dim:
            raise ValueError(
                f"The agent's latents have size {agent.architecture.latent_dim}, the buffer's {buffer.latent_dim}. "
                "Give both the same latent_dim."
            )
        optim = options.optim
        self._how: dict[str, Any] = {
            "bf16": wants_bf16(optim.autocast, next(agent.parameters()).device),
            "logger": logger,
            "progress": progress,
            "after_step": after_step,
        }
        self.dynamics = self._dynamics_learner()
        self.value, self.value_td = self._value_learner(), self._value_td_learner()
        self.safe_set = self._safe_set_learner()
        self.constraint = self._classifier_learner("constraint", buffer.keys.constraint)
        self.goal = self._classifier_learner("goal", buffer.keys.success)
        for name in options.loss.mean_latents:
            keys = {"latent": "loc", "next_latent": ("next", "loc")}
            self.learners[name].loss.set_keys(**(keys if name == "dynamics" else {"latent": ("next", "loc")}))
        self._group = LearnerGroup(self.learners)

    @property
    def learners(self) -> dict[str, Learner]:
        """The learners by name, in the order in which they are trained."""
        return {name: getattr(self, name) for name in LEARNERS}

    def _batches(self, loss: LatentLoss, members: int | None = None, **rows: Any) -> BatchStream:
        """Batches for a loss, from the ``rows`` that a :class:`~ls3_torchrl.data.RowSelection` describes."""
        selection = RowSelection(online_fraction=self.options.online.fraction, **rows)
        return BatchStream(self.buffer, self.options.optim.batch_size, selection, reads=loss, members=members)

    def _dynamics_learner(self) -> Learner:
        """Equation (2)."""
        options, dynamics = self.options, self.agent.dynamics
        horizon = options.loss.dynamics_horizon
        members = _members_of(dynamics)
        loss = EnsembleDynamicsLoss(dynamics, bootstrap=members is not None, steps=horizon)
        loss.set_keys(action=self.buffer.keys.action)
        # What follows a violation is frozen in many worlds, and no plan is to go through one.
        rows = {"without": "after_violation", "steps": horizon if horizon > 1 else None}
        batches = self._batches(loss, members, **rows)
        return Learner("dynamics", loss, batches, lr=options.optim.dynamics_lr, **self._how)

    def _value_learner(self) -> Learner:
        """Equation (3)."""
        options, value = self.options, self.agent.value
        members = _members_of(value)
        loss = OfflineValueLoss(value, bootstrap=members is not None)
        batches = self._batches(loss, members, tags=VALUE_TAGS)
        return Learner("value", loss, batches, lr=options.optim.lr, **self._how)

    def _value_td_learner(self) -> Learner:
        """Equation (4)."""
        options, value = self.options, self.agent.value
        members = _members_of(value)
        loss = TD1ValueLoss(
            value,
            gamma=self.buffer.gamma,
            zero_at_goal=options.loss.zero_at_goal,
            bootstrap=members is not None,
        )
        loss.set_keys(reward=self.buffer.keys.reward)
        batches = self._batches(loss, members, tags=VALUE_TAGS)
        interval = options.optim.target_interval
        return Learner("value", loss, batches, lr=options.optim.lr, target_interval=interval, **self._how)

    def _safe_set_learner(self) -> Learner:
        """Equation (5)."""
        options = self.options
        loss = SafeSetLoss(self.agent.safe_set, gamma=options.loss.gamma_safe_set)
        batches = self._batches(loss)
        if options.loss.timed_out_weight != 1.0:
            batches.extra_keys, batches.change = ("timed_out", "tag"), self._weigh
        return Learner(
            "safe_set",
            loss,
            batches,
            lr=options.optim.lr,
            target_interval=options.optim.target_interval,
            **self._how,
        )

    def _classifier_learner(self, name: str, label: NestedKey) -> Learner:
        loss = ClassifierLoss(getattr(self.agent, name), name=name)
        loss.set_keys(label=label)  # under the buffer's keys, which need not be the classifier's
        return Learner(name, loss, self._batches(loss), lr=self.options.optim.lr, **self._how)

    def _weigh(self, rows: TensorDictBase) -> TensorDictBase:
        """Rows for equation (5): how much online episodes that timed out count is an option."""
        timed_out = rows["timed_out"] & (rows["tag"] == int(Tag.ONLINE))
        return rows.set("safe_set_weight", torch.where(timed_out, self.options.loss.timed_out_weight, 1.0))

    def train_offline(self) -> None:
        """Train the latent models on the offline data (equations (2), (3), (4), (5) and the classifiers).

        Raises:
            ValueError: for actions that are not those of the agent.

        Warns:
            DataWarning: where no step succeeds, or none violates a constraint.
        """
        require_actions_of(self.agent, self.buffer)
        warn_of_missing_outcomes(self.buffer)
        steps = self.options.offline
        self._group.train(
            [
                ("dynamics", steps.dynamics_steps, "Dynamics"),
                ("value", steps.value_steps, "Value, reward-to-go"),
                *self._classifiers(steps.classifier_steps),
            ]
        )

    def update(self) -> None:
        """One update on all data, after new episodes."""
        steps = self.options.online
        self._group.train(
            [
                ("dynamics", steps.dynamics_steps, "Dynamics"),
                ("value_td", steps.value_td_steps, "Value, TD-1"),
                *self._classifiers(steps.classifier_steps),
            ]
        )

    def _classifiers(self, steps: int) -> list[Stage]:
        names = {"safe_set": "Safe set", "constraint": "Constraint", "goal": "Goal"}
        return [(name, steps, phase) for name, phase in names.items()]

    def state_dict(self) -> dict[str, Any]:
        """Networks, lagged networks, optimisers and counters of every learner.

        Taken by ``after_step``, it continues in the middle: the method that was training is to be called again.
        """
        return self._group.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken."""
        self._group.load_state_dict(state_dict)


def _members_of(module: TensorDictModuleBase) -> int | None:
    """Members of an ensemble, each of which learns from a batch of its own (Chua et al.); ``None`` for what is none."""
    return getattr(module, "num_members", None)
