"""A learner: one loss, its optimiser, its lagged target and its batches; what every phase of training is made of."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate

from common import RunFolder, progress
from ls3_torchrl.layers import fastest_precision

LOG_EVERY = 100


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Compute on ``count`` cores; on as many as before when ``None``."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def wants_bf16(setting: bool | str, device: torch.device) -> bool:
    """What a setting ``autocast`` of true, false or auto means on a device."""
    return fastest_precision(device.type) == "bf16" if setting == "auto" else bool(setting)


def cooled_down(share: float, cooldown: float) -> float:
    """What a learning rate has fallen to after a share of a phase's steps: 1, then linearly to 0 at the end."""
    return 1.0 if share < 1.0 - cooldown else (1.0 - share) / cooldown


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
        names: the losses ``loss_{name}`` are descended, in one step if there are several.
        loss: a TorchRL loss module.
        sample: draws a batch.
        lr: Adam's learning rate.
        target_interval: gradient steps between copies to the target network; ``None`` without one.
        tau: share of the way that the target network moves at every step instead.
        beside: a second loss that is added to the first.
        bf16: compute the losses under bf16 autocast; weights, gradients and optimiser stay fp32.
        cooldown: share of a phase's steps, at its end, over which the learning rate falls linearly to nothing: the
            last few batches then sway what the agent acts by no more than the others.
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
    ) -> None:
        self.names = [names] if isinstance(names, str) else list(names)
        self.loss, self.sample, self.auxiliary, self.bf16 = loss, sample, auxiliary, bf16
        self.lr, self.cooldown = lr, cooldown
        self.parameters = [p for p in loss.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(self.parameters, lr=lr, fused=True)
        self.target_interval, self.tau = target_interval, tau
        self.target: HardUpdate | SoftUpdate | None = None
        self.steps = 0

    def compute_loss(self) -> tuple[TensorDictBase, Tensor]:
        """What the losses write for a new batch, and the sum that is descended."""
        rows = self.sample()
        second = None if self.auxiliary is None else self.auxiliary.sample()
        with torch.autocast(self.parameters[0].device.type, torch.bfloat16, enabled=self.bf16):
            losses = self.loss(rows)
            value = torch.stack([losses[f"loss_{name}"] for name in self.names]).sum()
            if self.auxiliary is not None:
                auxiliary = self.auxiliary.loss(second)[f"loss_{self.names[0]}"]
                losses["auxiliary"] = auxiliary.detach()
                value = value + self.auxiliary.weight * auxiliary
        return losses, value

    def _tells(self, key: str, item: Tensor) -> bool:
        """Whether an output is worth logging: scalars, and of the losses those that are descended."""
        return item.numel() == 1 and (not key.startswith("loss_") or key.removeprefix("loss_") in self.names)

    def train(self, steps: int, what: str, run: RunFolder) -> None:
        """Take ``steps`` gradient steps."""
        if self.tau is not None and self.target is None:
            self.target = SoftUpdate(self.loss, tau=self.tau)
        if self.target_interval is not None and self.target is None:
            # Made at the first step, not before: it copies the network to its target, and another learner may have
            # trained that network meanwhile (reward-to-go before TD-1). It copies again at calls k + 1, 2(k + 1), …,
            # so k is one less than the interval that is meant.
            self.target = HardUpdate(self.loss, value_network_update_interval=self.target_interval - 1)
        # Networks of this size lose more by waking a second core than they gain by it.
        with threads(1), progress(steps, what) as bar:
            for i in range(steps):
                for group in self.optimizer.param_groups:
                    group["lr"] = self.lr * cooled_down(i / steps, self.cooldown)
                losses, value = self.compute_loss()
                self.optimizer.zero_grad()
                value.backward()
                self.optimizer.step()
                if self.target is not None:
                    self.target.step()
                self.steps += 1
                if i % LOG_EVERY == 0 or i == steps - 1:
                    scalars = {key: item.item() for key, item in losses.items() if self._tells(key, item)}
                    if not all(map(math.isfinite, scalars.values())):
                        raise FloatingPointError(
                            f"{what} diverged: {scalars} at step {self.steps}. Lower its learning rate."
                        )
                    bar.set_postfix_str(f"loss {value.item():.4g}", refresh=False)
                    run.log(what, self.steps, **scalars)
                bar.update()
