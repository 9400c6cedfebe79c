"""Hours of online updates: memory and handles do not grow."""

import gc
import os
import time
from pathlib import Path

import pytest
import torch
from tiny_runs import LS3

from ls3_recipes.algorithms import ls3
from ls3_recipes.configuration import train_settings
from ls3_recipes.experiment import Experiment
from ls3_recipes.protocol import run_experiment

# TorchRL warns about classes of its own while its collectors are imported.
pytestmark = pytest.mark.filterwarnings("ignore:Creating .* which inherits from WeightUpdaterBase:DeprecationWarning")

PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096
#: A full buffer, so that what is kept of episodes does not grow either.
FULL = ["buffer.capacity=700", "online.episodes_per_update=2", "evaluation.episodes=1"]


def memory():
    """Bytes of this process in memory."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def handles():
    """Open files of this process."""
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="the system does not tell")
def test_online_updates_leave_memory_and_handles_as_they_were(monkeypatch, tmp_path, soak):
    updates = 2000 if soak else 20
    seen, save = [], Experiment._keep_episodes

    def watched(self, update, episodes):
        save(self, update, episodes)
        if update % (updates // 20) == 0:
            seen.append((update, memory(), handles(), sum(issubclass(type(x), torch.Tensor) for x in gc.get_objects())))

    monkeypatch.setattr(Experiment, "_keep_episodes", watched)
    monkeypatch.setattr(ls3, "probe", lambda *_: {})
    start = time.monotonic()
    settings = train_settings(
        *LS3, *FULL, f"online.updates={updates}", "checkpoint_minutes=1", f"output={tmp_path / 'r'}"
    )
    run_experiment(settings)
    warm = len(seen) // 2
    growth = seen[-1][1] / seen[warm][1] - 1.0
    for update, size, files, tensors in seen:
        print(f"update {update}: {size / 2**20:.1f} MiB, {files} files open, {tensors} tensors")
    print(f"{updates} updates in {time.monotonic() - start:.0f} s: memory {growth:+.2%} over the second half")
    assert seen[-1][2] == seen[warm][2]
    assert growth < (0.01 if soak else 0.03)
    size = sum(path.stat().st_size for path in (tmp_path / "r" / "checkpoints").iterdir())
    print(f"{len(list((tmp_path / 'r' / 'checkpoints').iterdir()))} agents, {size / 2**20:.1f} MiB")
