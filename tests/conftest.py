"""What all tests share: a seed, one thread, a training loop, a small disk, numbers of made-up inputs, the long form."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

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


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--soak``: the long form of the tests of reliability."""
    parser.addoption("--soak", action="store_true", help="the long form of tests/reliability; it takes hours")


@pytest.fixture(scope="session")
def soak(request: pytest.FixtureRequest) -> bool:
    """Whether the long form of a test is asked for."""
    return request.config.getoption("--soak")


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


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """A function that makes a file system of so many bytes, which is gone after the test."""
    made: list[Path] = []

    def make(size: int) -> Path:
        folder = tmp_path / f"disk{len(made)}"
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
        if shutil.which("mount") is None or subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip("no file system can be mounted here")
        made.append(folder)
        return folder

    yield make
    for folder in made:
        subprocess.run(["umount", "-l", str(folder)], check=True)
