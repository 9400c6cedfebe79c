"""Files and folders that are whole or not there, and that tell whether they are still what was written."""

from __future__ import annotations

import errno
import json
import os
import shutil
import uuid
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import IO, Any

import torch

#: How files and folders end that are being written, or whose writing was cut off: they can be removed.
PARTIAL = ".partial"
_CHUNK = 1 << 22


def save_atomically(content: dict[str, Any], path: str | Path) -> Path:
    """``torch.save`` in one go: a half-written file never takes the place of a whole one.

    Args:
        content: what to save.
        path: where; its folder is made.

    Returns:
        The path.

    Raises:
        OSError: where it cannot be written, such as on a full disk; names the path.

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

    Raises:
        OSError: where it cannot be written, such as on a full disk; names the path.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     read_json(save_json_atomically({"answer": 42}, f"{folder}/file.json"))
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

    Raises:
        OSError: where it cannot be written, such as on a full disk; names the path.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_text_atomically("answer: 42", f"{folder}/file.yaml").read_text(encoding="utf-8")
        'answer: 42'
    """
    return _write_atomically(path, lambda file: file.write(text.encode("utf-8")))


def read_json(path: str | Path, *, remedy: str = "Restore it from a copy, or write it anew.") -> dict[str, Any]:
    """The dictionary in a JSON file.

    Args:
        path: the file.
        remedy: what to do where it is missing or damaged, a sentence.

    Raises:
        FileNotFoundError: where it is missing.
        ValueError: where it is not JSON in UTF-8, or no dictionary; names the file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing. {remedy}")
    try:
        content = json.loads(path.read_bytes().decode("utf-8"))
    except (ValueError, RecursionError) as error:  # of the text or of JSON
        raise ValueError(f"{path} is damaged: it is no JSON in UTF-8 ({error}). {remedy}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} is damaged: it holds a {type(content).__name__}, not a dictionary. {remedy}")
    return content


def file_manifest(folder: str | Path) -> dict[str, dict[str, Any]]:
    """Size and checksum of every file below a folder, by its path within, in order; what is half-written is left out.

    The checksum is CRC-32: it finds damage, at about 2 GB/s on one core, not forgery.

    Args:
        folder: where they lie.

    Returns:
        ``{"size": bytes, "crc32": hexadecimal}`` for each, as JSON can hold it and :func:`verify_files` takes it.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = save_text_atomically("answer", f"{folder}/deep/file.txt")
        ...     file_manifest(folder)
        {'deep/file.txt': {'size': 6, 'crc32': 'dadd4a25'}}
    """
    folder = Path(folder)
    found = ((path.relative_to(folder), path) for path in folder.rglob("*") if path.is_file())
    whole = {name.as_posix(): path for name, path in found if not any(part.endswith(PARTIAL) for part in name.parts)}
    return {name: {"size": path.stat().st_size, "crc32": checksum(path)} for name, path in sorted(whole.items())}


def verify_files(
    folder: str | Path, manifest: Any, *, remedy: str = "Restore the folder from a copy, or write it anew."
) -> None:
    """Check that files are what they were when :func:`file_manifest` was made. Other files are none of its concern.

    Args:
        folder: where they lie.
        manifest: of :func:`file_manifest`.
        remedy: what to do where they are not, a sentence.

    Raises:
        FileNotFoundError: where a file is missing; names it.
        ValueError: where a file has another size or content, names it; or for a manifest that is none, or names files
            outside of the folder.
    """
    folder = Path(folder)
    if not isinstance(manifest, Mapping):
        raise ValueError(f"The list of files of {folder} is damaged: it is a {type(manifest).__name__}. {remedy}")
    for name, entry in manifest.items():
        # Sizes of all come first: they cost nothing, and tell of most damage.
        if not isinstance(entry, Mapping) or set(entry) != {"size", "crc32"}:
            raise ValueError(f"The list of files of {folder} is damaged at {name!r}: got {entry!r}. {remedy}")
        path = inner_path(folder, name)
        if not path.is_file():
            raise FileNotFoundError(f"{path} is missing. {remedy}")
        if path.stat().st_size != entry["size"]:
            raise ValueError(f"{path} is damaged: {path.stat().st_size} bytes instead of {entry['size']}. {remedy}")
    for name, entry in manifest.items():
        if checksum(folder / name) != entry["crc32"]:
            raise ValueError(f"{folder / name} is damaged: its content is not what was written (CRC-32). {remedy}")


def inner_path(folder: Path, name: Any) -> Path:
    """A file below a folder by its path within.

    Raises:
        ValueError: for anything that is no such path, or leads out of the folder.
    """
    parts = PurePosixPath(name).parts if isinstance(name, str) else ()
    if not parts or ".." in parts or name.startswith("/") or "\\" in name or "\0" in name or ":" in parts[0]:
        raise ValueError(f"{name!r} is no file of {folder}: only files below it are read. Do not use this folder.")
    return folder.joinpath(*parts)


def checksum(path: Path) -> str:
    """CRC-32 of a file's content, eight hexadecimal digits."""
    value = 0
    with path.open("rb") as file:
        while part := file.read(_CHUNK):
            value = zlib.crc32(part, value)
    return f"{value:08x}"


def checksum_of(content: Any) -> str:
    """CRC-32 of content as JSON gives it back, eight hexadecimal digits."""
    return f"{zlib.crc32(json.dumps(content).encode('utf-8')):08x}"


@contextmanager
def new_folder(path: str | Path) -> Iterator[Path]:
    """Make a folder, whole or not at all: what the block writes below the folder it is given takes the place ``path``.

    Where the block fails, nothing is left. Where it is killed, a folder is left whose name ends in ``.partial``.

    Args:
        path: must not exist yet; the folder around it is made.

    Raises:
        FileExistsError: where something is there, also if it came while the block ran.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with new_folder(f"{folder}/data") as inside:
        ...         _ = (inside / "file.txt").write_text("whole", encoding="utf-8")
        ...     [path.name for path in Path(folder).iterdir()]
        ['data']
    """
    path = Path(path)
    _require_new(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_name(path)
    partial.mkdir()
    try:
        yield partial
        for file in partial.rglob("*"):
            _sync(file)
        _sync(partial)
        _require_new(path)
        try:
            partial.rename(path)
        except OSError as error:
            if path.exists():  # it came just now
                _require_new(path)
            raise OSError(
                error.errno, f"The new folder could not be put in its place ({error.strerror})", str(path)
            ) from error
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    _sync(path.parent)


def _require_new(path: Path) -> None:
    if path.exists() or path.is_symlink():
        raise FileExistsError(f"{path} exists already. Choose another folder, or remove it first.")


def partial_name(path: Path) -> Path:
    """A name beside ``path`` that nobody else uses and that tells of something half-written."""
    return path.with_name(f"{path.name}.{uuid.uuid4().hex[:12]}{PARTIAL}")


def allocate(path: Path) -> None:
    """Take the disk space for a file's size before it is written through memory, where a full disk kills the process.

    Raises:
        OSError: where there is too little; names the file.
    """
    size = path.stat().st_size
    if size == 0 or not hasattr(os, "posix_fallocate"):
        return
    with path.open("r+b") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS):  # this file system cannot
                raise _named(error, path, f"{size:,} bytes are needed") from error


def _named(error: OSError, path: Path, more: str = "nothing was left of it") -> OSError:
    return OSError(error.errno, f"{error.strerror}: the file could not be written, {more}", str(path))


def _sync(path: Path) -> None:
    """Have the disk keep a file's content, or a folder's names; where the system cannot, it goes without."""
    if os.name == "nt" and path.is_dir():
        return
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _write_atomically(path: str | Path, write: Callable[[IO[bytes]], Any]) -> Path:
    """Write beside the file, then put the new one in its place."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_name(path)
    try:
        with partial.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException as error:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        failed = _disk_error(error)
        if failed is not None:
            raise _named(failed, path) from error
        raise
    _sync(path.parent)
    return path


def _disk_error(error: BaseException | None) -> OSError | None:
    """The system's own error behind an error: ``torch.save`` hides it behind one of its writer."""
    while error is not None and not isinstance(error, OSError):
        error = error.__cause__ or error.__context__
    return error
