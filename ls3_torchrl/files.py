"""Files that are whole or not there."""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any
from uuid import uuid4

#: How a file is called that is being written; one that is left was being written when the process ended.
PARTIAL = ".partial"
#: Free bytes below which a write that failed is taken for one that found no room.
_NO_ROOM = 16 * 2**20
#: Of an archive's part: that it is a folder.
_FOLDER = 0x10


def save_atomically(content: Any, path: str | Path, *, compress: bool = False) -> Path:
    """``torch.save`` in one go: a half-written file never takes the place of a whole one.

    Args:
        content: what to save.
        path: where; its folder is made.
        compress: in less space, which takes longer; ``torch.load`` reads such files as well.

    Returns:
        The path.

    Example:
        >>> import tempfile, torch
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     torch.load(save_atomically({"answer": 42}, f"{folder}/new/file.pt"))
        {'answer': 42}
    """
    import torch  # here: texts, folders and full disks need none of it

    def write(file: IO[bytes]) -> None:
        if not compress:
            torch.save(content, file)
            return
        whole = io.BytesIO()
        torch.save(content, whole)
        with zipfile.ZipFile(whole) as parts, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
            for part in parts.infolist():
                packed.writestr(part.filename, parts.read(part), compresslevel=9)

    return _write_atomically(path, write)


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
        ...     load_json(save_json_atomically({"answer": 42}, f"{folder}/file.json"), "an example")
        {'answer': 42}
    """
    return save_text_atomically(json.dumps(content, indent=2) + "\n", path)


def load_json(path: str | Path, what: str) -> dict[str, Any]:
    """A dictionary of a JSON file.

    Args:
        path: the file.
        what: what it should be, for messages.

    Raises:
        FileNotFoundError: when there is none.
        ValueError: for a file that holds none; the message names it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}, {what}, is missing.")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError among them
        raise ValueError(f"{path} is not {what}, or is damaged: {error}. Use another copy of it.") from error
    if not isinstance(content, dict):
        raise ValueError(
            f"{path} is not {what}, or is damaged: it holds a {type(content).__name__}, not an object. "
            "Use another copy of it."
        )
    return content


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
    import torch

    path = Path(path)
    if not path.is_file():
        there = "it is a folder" if path.is_dir() else "there is no such file"
        raise FileNotFoundError(f"{path} is not {what}: {there}. Check the path.")
    try:
        # PyTorch writes a checksum for every part of its archive, and does not look at them when it reads.
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
            if damaged is None:  # of what is marked as a folder PyTorch reads nothing, without a word
                damaged = next((part.filename for part in archive.infolist() if part.external_attr & _FOLDER), None)
        if damaged is not None:
            raise ValueError(f"its part {damaged} does not match its checksum, or is marked as a folder")
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
    partial = _beside(path)  # of this process and thread alone
    try:
        with writing(partial, shown=path) as file:
            write(file)
        partial.replace(path)
        sync_folder(path.parent)
    finally:
        partial.unlink(missing_ok=True)
    return path


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.{uuid4().hex}{PARTIAL}")


@contextmanager
def writing(path: Path, *, shown: Path | None = None) -> Iterator[IO[bytes]]:
    """A file that is open for writing, and on the disk at the end of the block.

    Args:
        path: of the file.
        shown: how errors call it.

    Raises:
        OSError: naming the file; also where PyTorch's writer finds no room, which does not say so.
    """
    name = str(shown or path)
    try:
        with path.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise OSError(error.errno, f"{error.strerror or error}; it could not be written", name) from error
    except RuntimeError as error:
        if is_full(error, path.parent):
            raise OSError(errno.ENOSPC, "No space left on device; it could not be written", name) from error
        raise


def is_full(error: BaseException, folder: Path) -> bool:
    """Whether a write to a folder failed for want of room; PyTorch's writer does not say it.

    Args:
        error: with which it failed.
        folder: on the disk in question.
    """
    if isinstance(error, OSError):
        return error.errno in (errno.ENOSPC, errno.EDQUOT)
    return isinstance(error, RuntimeError) and folder.is_dir() and shutil.disk_usage(folder).free < _NO_ROOM


@contextmanager
def new_folder(path: str | Path, *, replace: bool = False) -> Iterator[Path]:
    """A folder to be filled in the block, that takes its place when it is whole; where that fails, nothing is left.

    Args:
        path: where it will be.
        replace: whether it takes the place of one that exists.

    Raises:
        FileExistsError: when the folder exists, unless it is to be replaced.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as there, new_folder(f"{there}/new") as folder:
        ...     _ = save_text_atomically("whole", folder / "file.txt")
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    new, old = _beside(path), _beside(path)
    new.mkdir()
    try:
        yield new
        for folder in sorted((p for p in new.rglob("*") if p.is_dir()), reverse=True):
            sync_folder(folder)
        sync_folder(new)
        if replace and path.exists():
            path.rename(old)
        _take_place(new, path)
        sync_folder(path.parent)
    finally:
        if old.exists() and not path.exists():
            old.rename(path)
        for left in (new, old):
            shutil.rmtree(left, ignore_errors=True)


def _take_place(new: Path, path: Path) -> None:
    try:
        new.rename(path)
    except OSError as error:
        if path.exists():
            raise FileExistsError(f"{path} exists already. Choose another folder, or remove it first.") from error
        raise


def sync_folder(folder: str | Path) -> None:
    """Bring the names in a folder to the disk: a file that was renamed is then found after a power cut as well."""
    if os.name == "nt":  # folders cannot be opened there
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
