"""Tensordict's memory maps: read without trusting them, and given the disk's space before they are written."""

from __future__ import annotations

import errno
import math
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import MemoryMappedTensor, TensorDictBase
from torch import Tensor

from ls3_torchrl.files import load_json


def read_memory_maps(folder: Path, where: tuple[str, ...] = ()) -> dict[tuple[str, ...], Tensor]:
    """The tensors of a folder that ``TensorDict.memmap`` has written, by key; nothing else in it is read.

    ``TensorDict.load_memmap`` would make a file that is too short longer, and fill it with zeros.

    Raises:
        FileNotFoundError: when a file is missing.
        ValueError: naming the file, when it is damaged.
    """
    path = folder / "meta.json"
    about = load_json(path, "a description of memory maps")
    found: dict[tuple[str, ...], Tensor] = {}
    for name, entry in about.items():
        if name.startswith("_") or name in ("shape", "device"):
            continue
        if not isinstance(entry, dict) or Path(name).name != name:
            raise ValueError(f"{path} says of {name!r} what it should not: it is damaged. Use another copy of it.")
        if {"dtype", "shape"} <= set(entry):
            found[(*where, name)] = _read_map(folder / f"{name}.memmap", entry, path)
        elif (folder / name / "meta.json").is_file():
            found |= read_memory_maps(folder / name, (*where, name))
        else:
            raise ValueError(f"{path} holds {name!r}, which is no tensor. Only tensors are read: nothing is run.")
    for part in sorted(p.name for p in folder.iterdir() if p.is_dir()):
        if (part in about) or not (folder / part / "meta.json").is_file():
            continue
        found |= read_memory_maps(folder / part, (*where, part))  # nested ones need not be listed
    return found


def _read_map(path: Path, entry: dict[str, Any], about: Path) -> Tensor:
    dtype, shape = getattr(torch, str(entry["dtype"]).removeprefix("torch."), None), entry["shape"]
    sound = isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)
    if not isinstance(dtype, torch.dtype) or not sound:
        raise ValueError(f"{about} says of {path.stem!r} what it should not: it is damaged. Use another copy of it.")
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing, although it was written. Use another copy of the folder.")
    wanted = math.prod(shape) * dtype.itemsize
    if path.stat().st_size != wanted:
        raise ValueError(
            f"{path} has {path.stat().st_size} bytes where {wanted} were written. Use another copy of the folder."
        )
    if not wanted:
        return torch.empty(shape, dtype=dtype)
    bytes_ = torch.from_numpy(np.memmap(path, dtype=np.uint8, mode="c", shape=(wanted,)))
    return bytes_.view(dtype).reshape(shape)


def require_free_space(folder: Path, size: int) -> None:
    """Raise ``OSError`` where a folder's disk has less than ``size`` bytes left."""
    free = shutil.disk_usage(folder).free
    if free < size:
        raise OSError(errno.ENOSPC, f"No space left on device: {size} bytes are needed, {free} are free", str(folder))


def reserve_rows(maps: TensorDictBase, start: int, count: int) -> None:
    """Take the disk's space for rows of memory maps that are about to be written.

    The files of new maps are holes; a write through memory that finds no space for one ends the process with SIGBUS.

    Args:
        maps: rows along the first dimension.
        start: number of the first row.
        count: how many.

    Raises:
        OSError: naming the file, when there is no space.
    """
    if not hasattr(os, "posix_fallocate"):  # the system has no such call
        return
    for leaf in maps.values(True, True):
        if not isinstance(leaf, MemoryMappedTensor) or leaf.filename is None:
            continue
        row = math.prod(leaf.shape[1:]) * leaf.itemsize
        if not row * count:
            continue
        handle = os.open(leaf.filename, os.O_RDWR)
        try:
            os.posix_fallocate(handle, start * row, count * row)
        except OSError as error:
            said = f"{error.strerror}: no space for {count} more rows"
            raise OSError(error.errno, said, str(leaf.filename)) from error
        finally:
            os.close(handle)
