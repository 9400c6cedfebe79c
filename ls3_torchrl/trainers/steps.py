"""What gradient steps of every kind have in common: cores, precision, learning rate, gradients, metrics and seeds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.nn.utils import get_total_norm
from torchrl.record.loggers import Logger

from ls3_torchrl.layers import fastest_precision
from ls3_torchrl.options.training import Autocast

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


def log_scalars(logger: Logger | None, phase: str, step: int, scalars: dict[str, float]) -> None:
    """Write metrics under ``phase/name``; nowhere without a logger."""
    if logger is not None:
        for name, value in scalars.items():
            logger.log_scalar(f"{phase}/{name}", value, step=step)


def new_seed(generator: torch.Generator | None = None) -> int:
    """A seed from a random stream, PyTorch's own when ``None``."""
    return int(torch.randint(2**63 - 1, (), generator=generator))


def set_gradients(parameters: Iterable[Parameter], value: Tensor) -> bool:
    """Compute the gradients of ``value``; whether it and the square of its gradient are finite.

    Otherwise no step is to be taken: Adam's average of squares would stay infinite for ever, and what it belongs to
    would never move again.
    """
    parameters = list(parameters)
    for parameter in parameters:
        parameter.grad = None
    value.backward()
    return is_finite(parameters, value)


def is_finite(parameters: Iterable[Tensor], value: Tensor) -> bool:
    """Whether a loss and the square of its gradient are finite."""
    # NaN and infinity outlast a norm, which is cheaper than a look at every entry.
    norm = get_total_norm([parameter.grad for parameter in parameters if parameter.grad is not None])
    return bool(torch.isfinite(value.detach() + norm))
