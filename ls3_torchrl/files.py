"""Files that are whole or not there."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import torch


def save_atomically(content: dict[str, Any], path: str | Path) -> Path:
    """``torch.save`` in one go: a half-written file never takes the place of a whole one.

    Args:
        content: what to save.
        path: where; its folder is made.

    Returns:
        The path.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torch.load(save_atomically({"answer": 42}, f"{folder}/new/file.pt"))
        {'answer': 42}
    """
    return _write_atomically(path, lambda file: torch.save(content, file))


def save_json_atomically(content: dict[str, Any], path: str | Path) -> Path:
    """A dictionary as JSON, whole or not at all.

    Args:
        content: what to save.
        path: where; its folder is made.

    Returns:
        The path.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     json.loads(save_json_atomically({"answer": 42}, f"{folder}/file.json").read_text())
        {'answer': 42}
    """
    return save_text_atomically(json.dumps(content, indent=2) + "\n", path)


def save_text_atomically(text: str, path: str | Path) -> Path:
    """A text in UTF-8, whole or not at all.

    Args:
        text: what to save.
        path: where; its folder is made.

    Returns:
        The path.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_text_atomically("answer: 42", f"{folder}/file.yaml").read_text()
        'answer: 42'
    """
    return _write_atomically(path, lambda file: file.write(text.encode()))


def _write_atomically(path: str | Path, write: Callable[[IO[bytes]], Any]) -> Path:
    """Write beside the file, then put the new one in its place."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
    return path
