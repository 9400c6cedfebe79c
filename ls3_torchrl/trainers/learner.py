"""Learner: one loss, its optimiser, its lagged target and its batches; what every phase of training is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.modules.dropout import _DropoutNd
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate
from torchrl.record.loggers import Logger

from ls3_torchrl._memory import keep_freed_memory
from ls3_torchrl.data import BatchStream
from ls3_torchrl.exceptions import DivergenceError
from ls3_torchrl.objectives.base import LatentLoss
from ls3_torchrl.objectives.lagged import LaggedTargetLoss
from ls3_torchrl.trainers.lagged_targets import LaggedTargets
from ls3_torchrl.trainers.progress import Bar, progress_bar
from ls3_torchrl.trainers.steps import LOG_INTERVAL, log_scalars, new_seed, set_gradients, threads


class Learner:
    """One loss module, its optimiser, its lagged target and where its batches come from.

    Args:
        names: the losses ``loss_{name}`` are minimised, in one step if there are several.
        loss: a TorchRL loss module.
        sample: draws a batch. With a :class:`~ls3_torchrl.data.BatchStream` here, every phase has a random stream of
            its own, and a :class:`LearnerGroup` may train it beside others.
        lr: Adam's learning rate.
        target_interval: gradient steps between copies to the target network; ``None`` without one.
        tau: fraction of the way that the target network moves at every step instead.
        bf16: compute the losses under bf16 autocast; weights, gradients and optimiser stay fp32.
        logger: one of TorchRL's (:func:`torchrl.record.loggers.get_logger`); gets every scalar as ``phase/name``.
        progress: show progress bars.
        after_step: called after every gradient step. The state that :meth:`state_dict` gives there continues in the
            middle of the phase, and whatever it raises ends the phase.

    Raises:
        DivergenceError: by :meth:`train`, when a loss or a gradient is not finite.

    Example:
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import GoalEstimator
        >>> from ls3_torchrl.objectives import ClassifierLoss
        >>> goal = GoalEstimator(8)
        >>> reached = {"latent": torch.zeros(4, 8), "success": torch.ones(4, 1, dtype=torch.bool)}
        >>> batch = TensorDict({"next": reached}, [4])
        >>> learner = Learner("goal", ClassifierLoss(goal), lambda: batch, lr=1e-3, progress=False)
        >>> learner.train(50, "Goal")
        >>> bool(goal.probability(torch.zeros(1, 8)) > 0.5), learner.steps
        (True, 50)
    """

    def __init__(
        self,
        names: str | Sequence[str],
        loss: LossModule,
        sample: Callable[[], TensorDictBase],
        *,
        lr: float,
        target_interval: int | None = None,
        tau: float | None = None,
        bf16: bool = False,
        logger: Logger | None = None,
        progress: bool = True,
        after_step: Callable[[], object] | None = None,
    ) -> None:
        self.names = [names] if isinstance(names, str) else list(names)
        self.loss, self.sample, self.lr, self.bf16 = loss, sample, lr, bf16
        self.logger, self.progress, self.after_step = logger, progress, after_step
        self.parameters = [p for p in loss.parameters() if p.requires_grad]
        #: ``None`` where there is nothing to train: a constraint that is known, a goal estimator that is frozen.
        self.optimizer = torch.optim.Adam(self.parameters, lr=lr, fused=True) if self.parameters else None
        self.target_interval, self.tau = target_interval, tau
        self.target: HardUpdate | SoftUpdate | None = None
        self._lagged_targets: LaggedTargets | None = None  # of the phase that it is in
        self.steps = 0
        self._phase_steps = 0  # of the phase that train() is in; kept for one that continues in the middle
        self._phase: tuple[int, str] | None = None  # that phase
        self._batch: TensorDictBase | None = None  # the last one

    @property
    def streams(self) -> list[BatchStream]:
        """Where its batches come from, as far as these have random streams of their own."""
        return [self.sample] if isinstance(self.sample, BatchStream) else []

    @property
    def is_independent(self) -> bool:
        """Whether all its random numbers are its own, with batches from streams and no dropout in its networks."""
        return bool(self.streams) and not any(isinstance(module, _DropoutNd) for module in self.loss.modules())

    @property
    def phase_steps(self) -> int:
        """Steps that were taken of the phase that it is in."""
        return self._phase_steps

    def compute_loss(self) -> tuple[dict[str, Tensor], Tensor]:
        """What the losses write for a new batch, and the sum that is minimised."""
        rows = self.new_batch()
        with self.autocast():
            losses = _values_of(self.loss, rows)
            value = losses[f"loss_{self.names[0]}"]
            for name in self.names[1:]:
                value = value + losses[f"loss_{name}"]
        return losses, value

    def new_batch(self) -> TensorDictBase:
        """The next batch, where the parameters are."""
        self._batch = self._as_parameters(self.sample())
        ahead = self._lagged_targets
        if ahead is not None and ahead.batches is self.sample and isinstance(self.target, HardUpdate):
            assert self._phase is not None
            ahead.add_to(self._batch, self.target.counter, self._phase[0] - self._phase_steps)
        return self._batch

    def autocast(self) -> torch.autocast:
        """In which its losses are computed."""
        return torch.autocast(self.parameters[0].device.type, torch.bfloat16, enabled=self.bf16)

    def _as_parameters(self, rows: TensorDictBase) -> TensorDictBase:
        """A batch where the parameters are, in their precision."""
        device, dtype = self.parameters[0].device, self.parameters[0].dtype
        if device.type != "cpu":
            rows = rows.to(device)
        if dtype != torch.float32:  # in which buffers keep what they hold
            rows = rows.apply(lambda entry: entry.to(dtype) if entry.is_floating_point() else entry)
        return rows

    def train(self, steps: int, phase: str, *, seed: int | None = None) -> None:
        """Take ``steps`` gradient steps, which are logged and shown as ``phase``; none where nothing can be trained.

        After :meth:`load_state_dict` of a state from the middle of a phase, or where ``after_step`` ended it, those
        that are left of it.

        Args:
            steps: in all.
            phase: its name.
            seed: of the phase's random streams; drawn from PyTorch's own stream when ``None``.

        Raises:
            DivergenceError: when a loss or a gradient is not finite.
            RuntimeError: for another phase than the one that was begun.
        """
        if self.optimizer is None:
            return
        with progress_bar(steps, phase, done=self.steps_done(steps, phase), enabled=self.progress) as bar:
            self.take_steps(steps, phase, bar, seed=seed, after_step=self.after_step)

    def steps_done(self, steps: int, phase: str) -> int:
        """Steps of a phase that were taken already.

        Raises:
            RuntimeError: for another phase than the one that was begun.
        """
        if self._phase not in (None, (steps, phase)):
            raise RuntimeError(
                f"{self._phase_steps} steps of {self._phase} were taken; now {(steps, phase)} is asked for. Call what "
                "was called then, which takes the steps that are left."
            )
        return self._phase_steps

    def take_steps(
        self,
        steps: int,
        phase: str,
        bar: Bar,
        *,
        seed: int | None = None,
        after_step: Callable[[], object] | None = None,
    ) -> None:
        """What :meth:`train` does, shown on a bar that others may share.

        Args:
            steps: in all.
            phase: its name.
            bar: advances with every step.
            seed: as in :meth:`train`.
            after_step: called after every step.
        """
        if self.optimizer is None:
            bar.update(steps)
            return
        self.begin(steps, phase, seed)
        # Networks of this size lose more by waking a second core than they gain by it.
        with threads(1):
            while self.phase_steps < steps:
                losses, value = self.compute_loss()
                if not set_gradients(self.parameters, value):
                    raise self.divergence(losses)
                self.step(losses, value, bar)
                if after_step is not None:
                    after_step()
        self.end()

    def begin(self, steps: int, phase: str, seed: int | None) -> None:
        """Begin a phase, unless it was begun before."""
        if self._phase is None and self.streams:
            own = torch.Generator().manual_seed(new_seed() if seed is None else seed)
            for stream in self.streams:
                stream.seed(new_seed(own))
        self._phase = (steps, phase)
        self._require_one_precision()
        keep_freed_memory()
        self._make_target()
        self._lagged_targets = self._targets_ahead()

    def _targets_ahead(self) -> LaggedTargets | None:
        """Targets for many batches at once, where the lagged network moves now and then alone."""
        if self.target_interval is None or self.tau is not None:
            return None
        if not isinstance(self.loss, LaggedTargetLoss) or type(self.sample) is not BatchStream:
            return None
        return LaggedTargets(self.loss, self.sample, self.target_interval, self._compute_targets)

    def _compute_targets(self, rows: TensorDictBase) -> Tensor:
        assert isinstance(self.loss, LaggedTargetLoss)
        with self.autocast():
            return self.loss.targets(self._as_parameters(rows))

    def _require_one_precision(self) -> None:
        kinds = {
            (parameter.device, parameter.dtype)
            for name, parameter in [*self.loss.named_parameters(), *self.loss.named_buffers()]
            if "target_" in name or parameter.requires_grad
            if parameter.is_floating_point()
        }
        if len(kinds) > 1:
            raise RuntimeError(
                f"{self.names[0]}: network and lagged network differ in device or dtype: {sorted(map(str, kinds))}. "
                "Move or cast the agent before its trainer is made."
            )

    def _make_target(self) -> None:
        """Make what moves the lagged network, at the first step and not before.

        It copies the network to its target, and another learner may have trained that network meanwhile (reward-to-go
        before TD-1).
        """
        if self.target is not None:
            return
        if self.tau is not None:
            self.target = SoftUpdate(self.loss, tau=self.tau)
        elif self.target_interval is not None:
            # It copies again at calls k + 1, 2(k + 1), …, so k is one less than the interval that is meant.
            self.target = HardUpdate(self.loss, value_network_update_interval=self.target_interval - 1)

    def step(self, losses: Mapping[str, Tensor], value: Tensor, bar: Bar) -> None:
        """Take a step along the gradients that there are, log it and show it."""
        assert self.optimizer is not None
        assert self._phase is not None
        steps, phase = self._phase
        self.optimizer.step()
        if self.target is not None:
            self.target.step()
        self.steps += 1
        if self._phase_steps % LOG_INTERVAL == 0 or self._phase_steps == steps - 1:
            log_scalars(self.logger, phase, self.steps, self._scalars(losses))
            bar.set_postfix_str(f"loss {value.item():.4g}", refresh=False)
        bar.update()
        self._phase_steps += 1

    def end(self) -> None:
        """End a phase."""
        self._phase_steps, self._phase, self._lagged_targets = 0, None, None

    def divergence(self, losses: Mapping[str, Tensor]) -> DivergenceError:
        """The error that the step which is not taken ends with."""
        phase = self.names[0] if self._phase is None else self._phase[1]
        return DivergenceError(phase, self.steps, self._scalars(losses), self._batch, "Lower its learning rate.")

    def _scalars(self, losses: Mapping[str, Tensor]) -> dict[str, float]:
        return {key: item.item() for key, item in losses.items() if self._is_metric(key, item)}

    def _is_metric(self, key: str, item: Tensor) -> bool:
        """Whether an output is worth logging: scalars, and of the losses those that are minimised."""
        return item.numel() == 1 and (not key.startswith("loss_") or key.removeprefix("loss_") in self.names)

    def state_dict(self) -> dict[str, Any]:
        """Networks, lagged networks, optimiser and counters, those in the middle of a phase included."""
        return {
            "loss": self.loss.state_dict(),
            "optimizer": None if self.optimizer is None else self.optimizer.state_dict(),
            "steps": self.steps,
            "phase_steps": self._phase_steps,
            "phase": self._phase,
            "has_target": self.target is not None,
            "target_counter": getattr(self.target, "counter", 0),
            "streams": [stream.state_dict() for stream in self.streams],
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken."""
        self.target = None
        if state_dict["has_target"]:
            self._make_target()
            if isinstance(self.target, HardUpdate):
                self.target.counter = state_dict["target_counter"]
        self.loss.load_state_dict(state_dict["loss"])
        if self.optimizer is not None:
            self.optimizer.load_state_dict(state_dict["optimizer"])
            for group in self.optimizer.param_groups:
                group["lr"] = self.lr  # that of this learner, which may be lower where the other one diverged
        self.steps, self._phase_steps = state_dict["steps"], state_dict["phase_steps"]
        self._phase = state_dict["phase"]
        for stream, state in zip(self.streams, state_dict["streams"], strict=True):
            stream.load_state_dict(state)


def _values_of(loss: LossModule, rows: TensorDictBase) -> dict[str, Tensor]:
    """What a loss writes; of the library's own without the work on dictionaries around it."""
    return loss.losses(rows) if isinstance(loss, LatentLoss) and loss.is_plain else dict(loss(rows).items())
