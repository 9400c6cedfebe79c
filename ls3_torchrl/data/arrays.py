"""Tensors in a folder, one NumPy file each, with sizes and checksums beside them."""

from __future__ import annotations

import io
import json
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ls3_torchrl.files import writing

#: Types that NumPy lacks, and those of the same width as which they are stored.
_STORED_AS = {torch.bfloat16: torch.int16}
_DTYPES = {str(dtype).removeprefix("torch."): dtype for dtype in vars(torch).values() if isinstance(dtype, torch.dtype)}
#: Bytes that are read at a time for a checksum.
_CHUNK = 2**22

#: What is known of a stored tensor: its key, file, dtype, shape, size in bytes and checksum.
Entry = dict[str, Any]


def write_array(folder: Path, branch: str, key: tuple[str, ...], parts: Sequence[Tensor]) -> Entry:
    """Write tensors ``[n_i, ...]`` behind one another to a file of ``folder``; returns what is known of it.

    They are written as files are, not through a memory map, which a full disk would end the process by.

    Args:
        folder: exists already.
        branch: folder in it.
        key: of the tensors.
        parts: at least one; alike but for their first dimension.

    Raises:
        OSError: naming the file.
    """
    first = parts[0]
    shape = (sum(map(len, parts)), *first.shape[1:])
    stored = _STORED_AS.get(first.dtype, first.dtype)
    kind = torch.empty(0, dtype=stored).numpy().dtype
    path = _free(folder / branch, re.sub(r"[^A-Za-z0-9_.-]", "_", "-".join(key)))
    path.parent.mkdir(parents=True, exist_ok=True)
    header = io.BytesIO()
    about = {"descr": np.lib.format.dtype_to_descr(kind), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, about)
    checksum = zlib.crc32(header.getvalue())
    with writing(path) as file:
        file.write(header.getvalue())
        for part in parts:
            content = part.detach().cpu().contiguous().view(stored).numpy().tobytes()
            checksum = zlib.crc32(content, checksum)
            file.write(content)
        size = file.tell()
    return {
        "key": list(key),
        "branch": branch,
        "file": f"{branch}/{path.name}",
        "dtype": str(first.dtype).removeprefix("torch."),
        "shape": list(shape),
        "size": size,
        "crc32": checksum,
    }


def _free(folder: Path, name: str) -> Path:
    """A file name of its own for each key, also where case or odd signs are all that tells keys apart."""
    taken = {path.name.lower() for path in folder.glob("*")} if folder.is_dir() else set()
    number, file = 1, f"{name}.npy"
    while file.lower() in taken:
        number += 1
        file = f"{name}-{number}.npy"
    return folder / file


def read_array(folder: Path, entry: Entry) -> Tensor:
    """A tensor of :func:`write_array`, after its size and checksum.

    It is mapped from the disk, and written into without changing the file.

    Raises:
        FileNotFoundError: when its file is missing.
        ValueError: naming the file, when it is not what was written.
    """
    path = _inside(folder, entry["file"])
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing, although it was written. Use another copy of {folder}.")
    size = path.stat().st_size
    if size != entry["size"]:
        raise ValueError(f"{path} has {size} bytes where {entry['size']} were written. Use another copy of {folder}.")
    if _checksum(path) != entry["crc32"]:
        raise ValueError(f"{path} does not match its checksum: it is damaged. Use another copy of {folder}.")
    dtype = _DTYPES[entry["dtype"]]
    try:
        array = np.load(path, mmap_mode="c" if np.prod(entry["shape"]) else None, allow_pickle=False)
    except (ValueError, OSError, EOFError, SyntaxError) as error:
        raise ValueError(f"{path} is damaged: {error}. Use another copy of {folder}.") from error
    stored = torch.empty(0, dtype=_STORED_AS.get(dtype, dtype)).numpy().dtype
    if list(array.shape) != entry["shape"] or array.dtype != stored:
        raise ValueError(
            f"{path} holds {array.dtype} {list(array.shape)} where {stored} {entry['shape']} were written. "
            f"Use another copy of {folder}."
        )
    return torch.from_numpy(np.asarray(array)).view(dtype)


def _inside(folder: Path, name: Any) -> Path:
    """A file below ``folder``, and nowhere else."""
    parts = Path(str(name)).parts
    if not parts or ".." in parts or Path(str(name)).is_absolute():
        raise ValueError(f"{folder} names a file outside of itself, {name!r}: it is damaged. Use another copy of it.")
    return folder.joinpath(*parts)


def _checksum(path: Path) -> int:
    checksum = 0
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            checksum = zlib.crc32(chunk, checksum)
    return checksum


def with_checksum(description: dict[str, Any]) -> dict[str, Any]:
    """A description with a checksum of what it says, so that an edit of it is noticed."""
    return {**description, "checksum": _said(description)}


def require_checksum(description: dict[str, Any], path: Path) -> None:
    """Raise ``ValueError`` when a description is not as :func:`with_checksum` left it."""
    said = {name: value for name, value in description.items() if name != "checksum"}
    if description.get("checksum") != _said(said):
        raise ValueError(
            f"{path} does not match its checksum: it is damaged, or was edited by hand. Use another copy of it, or "
            "save anew what it describes."
        )


def _said(description: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(description, sort_keys=True).encode())
