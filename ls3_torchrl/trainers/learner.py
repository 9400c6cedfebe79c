"""Learner: one loss, its optimiser, its lagged target and its batches; what every phase of training is made of."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate
from torchrl.record.loggers import Logger

from ls3_torchrl.layers import fastest_precision
from ls3_torchrl.trainers.options import Autocast
from ls3_torchrl.trainers.progress import progress_bar

#: Gradient steps between logged metrics.
LOG_INTERVAL = 100


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Compute on ``count`` cores; on as many as before when ``None``."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def wants_bf16(autocast: Autocast, device: torch.device) -> bool:
    """What ``autocast`` of true, false or ``"auto"`` means on a device."""
    return fastest_precision(device.type) == "bf16" if autocast == "auto" else bool(autocast)


def cooled_down(fraction: float, cooldown: float) -> float:
    """What a learning rate has fallen to after a fraction of a phase's steps: 1, then linearly to 0 at the end."""
    return 1.0 if fraction < 1.0 - cooldown else (1.0 - fraction) / cooldown


def log_scalars(logger: Logger | None, phase: str, step: int, scalars: dict[str, float]) -> None:
    """Write metrics under ``phase/name``; nowhere without a logger."""
    if logger is not None:
        for name, value in scalars.items():
            logger.log_scalar(f"{phase}/{name}", value, step=step)


class AuxiliaryLoss(NamedTuple):
    """A second loss on the same network, with batches of its own.

    Attributes:
        weight: of its value in the sum.
        loss: the loss module.
        sample: draws a batch for it.
    """

    weight: float
    loss: LossModule
    sample: Callable[[], TensorDictBase]


class Learner:
    """One loss module, its optimiser, its lagged target and where its batches come from.

    Args:
        names: the losses ``loss_{name}`` are minimised, in one step if there are several.
        loss: a TorchRL loss module.
        sample: draws a batch.
        lr: Adam's learning rate.
        target_interval: gradient steps between copies to the target network; ``None`` without one.
        tau: fraction of the way that the target network moves at every step instead.
        auxiliary: a second loss that is added to the first.
        bf16: compute the losses under bf16 autocast; weights, gradients and optimiser stay fp32.
        cooldown: fraction of a phase's steps, at its end, over which the learning rate falls linearly to nothing: the
            last few batches then sway what the agent acts by no more than the others.
        logger: one of TorchRL's (:func:`torchrl.record.loggers.get_logger`); gets every scalar as ``phase/name``.
        progress: show progress bars.

    Raises:
        FloatingPointError: by :meth:`train`, when a loss is not finite.

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
        auxiliary: AuxiliaryLoss | None = None,
        bf16: bool = False,
        cooldown: float = 0.0,
        logger: Logger | None = None,
        progress: bool = True,
    ) -> None:
        self.names = [names] if isinstance(names, str) else list(names)
        self.loss, self.sample, self.auxiliary, self.bf16 = loss, sample, auxiliary, bf16
        self.lr, self.cooldown = lr, cooldown
        self.logger, self.progress = logger, progress
        self.parameters = [p for p in loss.parameters() if p.requires_grad]
        #: ``None`` where there is nothing to train: a constraint that is known, a goal estimator that is frozen.
        self.optimizer = torch.optim.Adam(self.parameters, lr=lr, fused=True) if self.parameters else None
        self.target_interval, self.tau = target_interval, tau
        self.target: HardUpdate | SoftUpdate | None = None
        self.steps = 0

    def compute_loss(self) -> tuple[TensorDictBase, Tensor]:
        """What the losses write for a new batch, and the sum that is minimised."""
        rows = self._as_parameters(self.sample())
        second = None if self.auxiliary is None else self._as_parameters(self.auxiliary.sample())
        with torch.autocast(self.parameters[0].device.type, torch.bfloat16, enabled=self.bf16):
            losses = self.loss(rows)
            value = torch.stack([losses[f"loss_{name}"] for name in self.names]).sum()
            if self.auxiliary is not None:
                auxiliary = self.auxiliary.loss(second)[f"loss_{self.names[0]}"]
                losses["auxiliary"] = auxiliary.detach()
                value = value + self.auxiliary.weight * auxiliary
        return losses, value

    def _as_parameters(self, rows: TensorDictBase) -> TensorDictBase:
        """A batch where the parameters are, in their precision."""
        device, dtype = self.parameters[0].device, self.parameters[0].dtype
        if device.type != "cpu":
            rows = rows.to(device)
        if dtype != torch.float32:  # in which buffers keep what they hold
            rows = rows.apply(lambda entry: entry.to(dtype) if entry.is_floating_point() else entry)
        return rows

    def train(self, steps: int, phase: str) -> None:
        """Take ``steps`` gradient steps, which are logged and shown as ``phase``; none where nothing can be trained."""
        if self.optimizer is None:
            return
        self._require_one_precision()
        self._make_target()
        # Networks of this size lose more by waking a second core than they gain by it.
        with threads(1), progress_bar(steps, phase, enabled=self.progress) as bar:
            for i in range(steps):
                for group in self.optimizer.param_groups:
                    group["lr"] = self.lr * cooled_down(i / steps, self.cooldown)
                losses, value = self._step()
                if i % LOG_INTERVAL == 0 or i == steps - 1:
                    self._log(phase, losses)
                    bar.set_postfix_str(f"loss {value.item():.4g}", refresh=False)
                bar.update()

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

    def _step(self) -> tuple[TensorDictBase, Tensor]:
        assert self.optimizer is not None
        losses, value = self.compute_loss()
        self.optimizer.zero_grad()
        value.backward()
        self.optimizer.step()
        if self.target is not None:
            self.target.step()
        self.steps += 1
        return losses, value

    def _log(self, phase: str, losses: TensorDictBase) -> None:
        scalars = {key: item.item() for key, item in losses.items() if self._is_metric(key, item)}
        if not all(map(math.isfinite, scalars.values())):
            raise FloatingPointError(f"{phase} diverged: {scalars} at step {self.steps}. Lower its learning rate.")
        log_scalars(self.logger, phase, self.steps, scalars)

    def _is_metric(self, key: str, item: Tensor) -> bool:
        """Whether an output is worth logging: scalars, and of the losses those that are minimised."""
        return item.numel() == 1 and (not key.startswith("loss_") or key.removeprefix("loss_") in self.names)

    def state_dict(self) -> dict[str, Any]:
        """Networks, lagged networks, optimiser and counters."""
        return {
            "loss": self.loss.state_dict(),
            "optimizer": None if self.optimizer is None else self.optimizer.state_dict(),
            "steps": self.steps,
            "has_target": self.target is not None,
            "target_counter": getattr(self.target, "counter", 0),
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
        self.steps = state_dict["steps"]
