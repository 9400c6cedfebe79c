"""Files that are whole or not there."""

from __future__ import annotations

import errno
import json
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any
from uuid import uuid4

import torch

#: How a file is called that is being written; one that is left was being written when the process ended.
PARTIAL = ".partial"
#: Free bytes below which a write that failed is taken for one that found no room.
_NO_ROOM = 16 * 2**20


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


def load_verified(path: str | Path, what: str) -> Any:
    """Read a file of :func:`save_atomically` after its checksums; no code in it is run.

    Args:
        path: the file.
        what: what it should be, for messages, such as "an agent file".

    Raises:
        FileNotFoundError: when there is none.
        ValueError: for a damaged file, or one of another kind; the message names the file.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     load_verified(save_atomically({"answer": 42}, f"{folder}/file.pt"), "an example")
        {'answer': 42}
    """
    path = Path(path)
    if not path.is_file():
        there = "it is a folder" if path.is_dir() else "there is no such file"
        raise FileNotFoundError(f"{path} is not {what}: {there}. Check the path.")
    try:
        # PyTorch writes a checksum for every part of its archive, and does not look at them when it reads.
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"its part {damaged} does not match its checksum")
        return torch.load(path, map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception as error:  # whatever damage makes of a file
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise ValueError(
            f"{path} is not {what}, or is damaged: {reason}. Use another copy of it, or make it anew."
        ) from error


def _write_atomically(path: str | Path, write: Callable[[IO[bytes]], Any]) -> Path:
    """Write beside the file, then put the new one in its place; where that fails, the file before it stays.

    Raises:
        OSError: naming the path.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{uuid4().hex}{PARTIAL}")  # of this process and thread alone
    try:
        with partial.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise OSError(error.errno, f"{error.strerror or error}; it could not be written", str(path)) from error
    except RuntimeError as error:  # PyTorch's writer, which does not say why
        if shutil.disk_usage(path.parent).free < _NO_ROOM:
            raise OSError(errno.ENOSPC, "No space left on device; it could not be written", str(path)) from error
        raise
    finally:
        partial.unlink(missing_ok=True)
    return path


def sync_folder(folder: str | Path) -> None:
    """Bring the names in a folder to the disk: a file that was renamed is then found after a power cut as well."""
    if os.name == "nt":  # folders cannot be opened there
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
