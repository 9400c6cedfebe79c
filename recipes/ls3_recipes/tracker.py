"""Where metrics go beside the run's folder: Weights & Biases."""

from __future__ import annotations

import hashlib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchrl.record.loggers import Logger, get_logger


def require_tracker(name: str | None) -> None:
    """Raise ``ModuleNotFoundError`` for a tracker that is not installed."""
    if name is not None and find_spec(name) is None:
        raise ModuleNotFoundError(f"tracker={name} needs a package: pip install {name}.", name=name)


def make_tracker(name: str, folder: Path, config: dict[str, Any]) -> Logger:
    """TorchRL's logger for a run, the same one when the run goes on.

    Without a network, ``WANDB_MODE=offline`` keeps everything in the run's folder, for ``wandb sync``.

    Args:
        name: of the tracker.
        folder: of the run, which it is named after.
        config: the run's settings.
    """
    own = hashlib.sha256(str(folder.absolute()).encode()).hexdigest()[:12]
    how = {"id": own, "project": "ls3", "config": config, "log_env_packages": False}
    tracker = get_logger(name, str(folder), folder.name, wandb_kwargs=how)
    assert tracker is not None
    return tracker
