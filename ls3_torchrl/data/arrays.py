"""Folders of arrays, in the layout of TensorDict's memory maps, of which nothing is ever run and nothing written to."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDictBase, is_leaf_nontensor
from torch import Tensor

from ls3_torchrl.data.keys import as_tuple
from ls3_torchrl.files import read_json, save_json_atomically

#: What entries cannot be called: TensorDict's description of a folder has these words for itself.
_TAKEN = {"shape", "device", "_type", "meta"}
_META = "meta.json"


def keys_of(data: TensorDictBase) -> list[tuple[str, ...]]:
    """The keys of all entries, of those that are no tensors too."""
    return [as_tuple(key) for key in data.keys(True, True, is_leaf=is_leaf_nontensor)]


def require_file_names(keys: Iterable[tuple[str, ...]], name: str) -> None:
    """Raise ``ValueError`` for keys that cannot be names of files."""
    for key in keys:
        for part in key:
            if part in _TAKEN or part in ("", ".", "..") or any(sign in part for sign in '/\\\0:*?"<>|'):
                raise ValueError(
                    f"{name}: an entry called {part!r} (in {key}) cannot be a file of that name. Rename the entry."
                )


def write_arrays(folder: Path, arrays: Mapping[tuple[str, ...], Iterable[Tensor]], batch_size: list[int]) -> None:
    """Write each array as one file: its parts behind one another, at least one of them.

    Args:
        folder: which exists.
        arrays: parts by key, ``[n_i, ...]`` each.
        batch_size: of the TensorDict that ``TensorDict.load_memmap`` would find here.

    Raises:
        OSError: on a full disk; names the file.
    """
    metas: dict[tuple[str, ...], dict[str, Any]] = {(): {}}
    for key, parts in arrays.items():
        for depth in range(1, len(key)):
            metas.setdefault(key[:depth], {})
            metas[key[: depth - 1]][key[depth - 1]] = {"type": "TensorDict"}
        path = folder.joinpath(*key[:-1], f"{key[-1]}.memmap")
        path.parent.mkdir(parents=True, exist_ok=True)
        shape, dtype = _write_file(path, parts)
        metas[key[:-1]][key[-1]] = {"device": "cpu", "shape": shape, "dtype": str(dtype), "is_nested": False}
    for key, entries in metas.items():
        kind = {"shape": batch_size, "device": "cpu", "_type": "<class 'tensordict._td.TensorDict'>"}
        save_json_atomically({**kind, **entries}, folder.joinpath(*key, _META))


def _write_file(path: Path, parts: Iterable[Tensor]) -> tuple[list[int], torch.dtype]:
    count, shape, dtype = 0, [], torch.float32
    try:
        with path.open("xb") as file:
            for part in parts:  # by ordinary writes: through memory, a full disk would kill the process
                values = part.detach().cpu().contiguous()
                if values.numel():
                    file.write(cast(Any, values.reshape(-1).view(torch.uint8).numpy()))
                count, shape, dtype = count + len(part), list(part.shape[1:]), part.dtype
    except OSError as error:
        raise OSError(error.errno, f"{error.strerror}: an array could not be written", str(path)) from error
    return [count, *shape], dtype


def read_arrays(folder: Path, *, remedy: str) -> dict[tuple[str, ...], Tensor]:
    """The arrays below a folder as private memory maps: writing into them changes no file.

    Args:
        folder: of :func:`write_arrays`, or of TensorDict's ``memmap``.
        remedy: what to do where it is damaged, a sentence.

    Raises:
        FileNotFoundError: where a file is missing; names it.
        ValueError: where a file is damaged, names it; or holds anything but arrays, of which nothing is run.
    """
    arrays: dict[tuple[str, ...], Tensor] = {}
    _read_folder(folder, (), arrays, remedy)
    return arrays


def _read_folder(folder: Path, at: tuple[str, ...], arrays: dict[tuple[str, ...], Tensor], remedy: str) -> None:
    meta = folder.joinpath(*at, _META)
    for name, entry in read_json(meta, remedy=remedy).items():
        if name in _TAKEN:
            continue
        require_file_names([(*at, name)], str(meta))
        if not isinstance(entry, dict):
            raise ValueError(f"{meta} is damaged: it describes {name!r} by {entry!r}. {remedy}")
        if "dtype" in entry:
            arrays[*at, name] = _read_file(folder.joinpath(*at, f"{name}.memmap"), meta, name, entry, remedy)
        elif entry.get("type") == "TensorDict":
            _read_folder(folder, (*at, name), arrays, remedy)
        else:
            raise ValueError(
                f"{meta} names an entry {name!r} that is not an array ({entry.get('type')!r}). Only arrays are read, "
                "nothing else is loaded or run. Do not use this folder unless you wrote it; leave such entries out."
            )


def _read_file(path: Path, meta: Path, name: str, entry: dict[str, Any], remedy: str) -> Tensor:
    dtype, shape = getattr(torch, str(entry["dtype"]).removeprefix("torch."), None), entry.get("shape")
    if not isinstance(dtype, torch.dtype) or entry.get("is_nested") or not _is_shape(shape):
        raise ValueError(f"{meta} is damaged: it describes {name!r} by {entry!r}. {remedy}")
    assert shape is not None
    count = math.prod(shape)
    if count == 0:
        return torch.empty(shape, dtype=dtype)  # there may be no file
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing. {remedy}")
    # Sizes first: a map beyond a file's end would be read as zeros, or kill the process.
    there, needed = path.stat().st_size, count * dtype.itemsize
    if there != needed:
        raise ValueError(f"{path} is damaged: it has {there} bytes, but {shape} of {dtype} are {needed}. {remedy}")
    return torch.from_file(str(path), shared=False, size=count, dtype=dtype).reshape(shape)


def _is_shape(shape: Any) -> bool:
    return isinstance(shape, list) and all(type(size) is int and size >= 0 for size in shape)
