"""Files that are whole or not there."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch


def save_atomically(content: dict[str, Any], path: str | Path) -> Path:
    """``torch.save`` in one go: a half-written file never takes the place of a whole one.

    Args:
        content: what to save.
        path: where; its folder is made.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torch.load(save_atomically({"answer": 42}, f"{folder}/new/file.pt"))
        {'answer': 42}
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
    return path
