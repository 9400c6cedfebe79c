"""What all tests share: one seed, one thread, a short training loop, and how many inputs are made up for a property."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import HealthCheck, settings
from tensordict import TensorDictBase
from torchrl.objectives import LossModule

# The same inputs on every machine, and no clock: a slow day fails nothing. Others every time:
# pytest --hypothesis-profile=other.
settings.register_profile(
    "same", derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck), print_blob=True
)
settings.register_profile("other", settings.get_profile("same"), derandomize=False)
settings.load_profile("same")


@pytest.fixture(autouse=True)
def _seeded_on_one_thread() -> None:
    torch.manual_seed(0)
    torch.set_num_threads(1)


@pytest.fixture
def minimise() -> Callable[..., tuple[float, float]]:
    """A function that trains a loss on one batch and returns its first and last value."""

    def train(
        loss: LossModule, batch: TensorDictBase, key: str, *, steps: int, lr: float, updater: object = None
    ) -> tuple[float, float]:
        optimiser = torch.optim.Adam([p for p in loss.parameters() if p.requires_grad], lr)
        first = last = float("nan")
        for step in range(steps):
            value = loss(batch)[key]
            optimiser.zero_grad()
            value.backward()
            optimiser.step()
            if updater is not None:
                updater.step()
            last = value.item()
            first = last if step == 0 else first
        return first, last

    return train
