"""A TorchRL replay buffer that keeps its first rows, whose ring of later ones can grow, be memory-mapped and saved."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer, TensorDictRoundRobinWriter
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.data.replay_buffers.storages import Storage

from ls3_torchrl.data.arrays import read_array, require_checksum, with_checksum, write_array
from ls3_torchrl.data.keys import as_tuple
from ls3_torchrl.data.memory_maps import read_memory_maps, require_free_space, reserve_rows
from ls3_torchrl.files import load_json, new_folder, save_json_atomically

#: Rows that are copied at a time where all of them might not fit into memory.
_CHUNK = 1024
#: What the first row may take in files of its own, beyond its size.
_FIRST_BYTES = 2**20
_META = "meta.json"
#: Marks a folder that a store made for its own use.
_SCRATCH = "scratch.txt"


class Dump(NamedTuple):
    """What was saved of a store.

    Attributes:
        rows: ``[n]``; ``None`` without any.
        counters: of the ring.
    """

    rows: TensorDictBase | None
    counters: dict[str, Any]


class RowStore(TensorDictReplayBuffer):
    """Rows that are kept, and a ring behind them: where it is full, its oldest rows are overwritten.

    ``state_dict`` and ``dumps`` hold the rows that there are and not the room for others, and ``loads`` reads no
    pickles; TorchRL's own save the whole room. Restored rows lie where they lay, so that equal random draws find equal
    rows.

    Args:
        capacity: rows kept.
        folder: memory-map the rows here instead of holding them in memory. What an earlier store left here is
            removed before the first row is written; a store that still uses it keeps its rows.
        device: where rows in memory live.

    Raises:
        FileExistsError: on the first write, when the folder holds anything but an earlier store.

    Example:
        >>> store = RowStore(2)
        >>> _ = store.extend(TensorDict({"x": torch.arange(3).unsqueeze(-1)}, [3]))
        >>> store.storage[:]["x"].flatten().tolist()
        [2, 1]
        >>> store.grow(4)
        >>> store.storage[:]["x"].flatten().tolist()
        [1, 2]
        >>> store.keep()
        >>> _ = store.extend(TensorDict({"x": torch.arange(3, 6).unsqueeze(-1)}, [3]))
        >>> store.storage[:]["x"].flatten().tolist()
        [1, 2, 5, 4]
    """

    def __init__(self, capacity: int, *, folder: str | Path | None = None, device: torch.device | str = "cpu") -> None:
        self._folder = None if folder is None else Path(folder)
        self._device = torch.device(device)
        #: Rows at the beginning that are never overwritten.
        self.kept = 0
        super().__init__(
            storage=self._make_storage(capacity), sampler=RandomSampler(), writer=TensorDictRoundRobinWriter()
        )

    def _make_storage(self, capacity: int) -> Storage:
        if self._folder is None:
            return LazyTensorStorage(capacity, device=self._device)
        return LazyMemmapStorage(capacity, scratch_dir=str(self._folder))

    @property
    def capacity(self) -> int:
        """Rows that there is room for."""
        return self.storage.max_size

    @property
    def cursor(self) -> int:
        """Where the next row will be written."""
        return self.writer.state_dict()["_cursor"]

    def extend(self, rows: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Write rows ``[n]``; returns where, int64 ``[n]``."""
        if self._folder is not None and not self.storage.initialized:
            _clear(self._folder, _is_scratch)
            self._folder.mkdir(parents=True, exist_ok=True)
            (self._folder / _SCRATCH).write_text(
                "A replay buffer's memory while it is in use; it can be removed.\n", encoding="utf-8"
            )
        written, rows = [], rows.detach()
        if len(rows) and self.kept == self.capacity:
            raise RuntimeError(f"All {self.capacity} rows are kept, and none may be overwritten. Make a larger store.")
        while len(rows):
            room = self.capacity - self.cursor
            if self._folder is not None:
                if not self.storage.initialized:
                    require_free_space(self._folder, rows[:room].bytes() + _FIRST_BYTES)
                    room = 1  # the files are made by the first row, and have their space from the second on
                else:
                    reserve_rows(self.storage[:], self.cursor, min(len(rows), room))
            # Else a store that is first written under inference_mode() could never be written outside of it.
            with torch.inference_mode(False), torch.no_grad():
                written.append(super().extend(rows[:room], update_priority=update_priority))
            if self.cursor == 0:  # it came to the end
                self._set_writer(self.kept, self.write_count)
            rows = rows[room:]
        return torch.cat(written) if written else torch.zeros(0, dtype=torch.long)

    def keep(self) -> None:
        """Never overwrite the rows that there are; those to come are a ring behind them.

        Raises:
            RuntimeError: when rows were overwritten already, and the oldest are not the first.
        """
        if self.write_count > self.capacity:
            raise RuntimeError("Rows were overwritten already. Call keep() before the store is full.")
        self.kept = len(self)
        if self.cursor == 0:
            self._set_writer(self.kept % self.capacity, self.write_count)

    def later(self, index: Tensor, steps: Tensor | int) -> Tensor:
        """Where the rows lie that were written ``steps`` after those of an index; within an episode, or nowhere."""
        ring = max(self.capacity - self.kept, 1)
        there = index + steps
        return torch.where(index < self.kept, there, self.kept + (there - self.kept) % ring)

    def _set_writer(self, cursor: int, write_count: int) -> None:
        self.writer.load_state_dict({"_cursor": cursor, "_write_count": write_count})

    def grow(self, capacity: int) -> None:
        """Make room for more rows; those of the ring then lie in their order behind those that are kept."""
        old, count, kept, written = self.storage, len(self), self.kept, self.write_count
        start = self.cursor - kept if count == self.capacity else 0
        ring = max(count - kept, 1)
        self.set_storage(self._make_storage(capacity))
        self.set_writer(TensorDictRoundRobinWriter())
        # A memory-mapped store writes to the folder that it reads from: its old files, although removed, stay readable
        # until the old storage is let go.
        for begin in range(0, count, _CHUNK):
            rows = torch.arange(begin, min(begin + _CHUNK, count), device=self._device)
            self.extend(old[torch.where(rows < kept, rows, kept + (rows - kept + start) % ring)])
        self._set_writer(count if count < capacity else kept, written)

    def state_dict(self) -> dict[str, Any]:
        """A copy of the rows and the ring's counters, which ``torch.load(weights_only=True)`` can read."""
        rows = self.storage[:].clone().to_dict() if len(self) else {}
        return {"rows": rows, **self._counters()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the rows and counters of another store."""
        count = state_dict["count"]
        self.restore(Dump(TensorDict(state_dict["rows"], [count]) if count else None, state_dict))

    def dumps(self, path: str | Path) -> None:
        """Write the rows and counters to the folder ``path``; an earlier dump there stays until this one is whole.

        Raises:
            FileExistsError: for a folder with other files.
            OSError: naming the file, when it cannot be written, as on a full disk.
        """
        path = Path(path)
        require_own(path, _is_dump)
        with new_folder(path, replace=True) as new:
            rows = self.storage[:] if len(self) else TensorDict({}, [0])
            entries = [write_array(new, "rows", as_tuple(key), [value]) for key, value in rows.items(True, True)]
            save_json_atomically(with_checksum({**self._counters(), "entries": entries}), new / _META)

    def loads(self, path: str | Path) -> None:
        """Take over rows and counters from the folder ``path``; no pickles are read.

        Raises:
            FileNotFoundError: for a folder without a dump, or when a file of it is missing.
            ValueError: naming the file, when it is damaged; the store stays as it was.
        """
        self.restore(self.read(path))

    @staticmethod
    def read(path: str | Path) -> Dump:
        """What :meth:`dumps` has written, after its checksums; mapped from the disk."""
        path = Path(path)
        counters = load_json(path / _META, "a description of saved rows")
        rows = None
        if "entries" in counters:
            require_checksum(counters, path / _META)
            if counters["count"]:
                found = {tuple(entry["key"]): read_array(path, entry) for entry in counters["entries"]}
                rows = TensorDict(found, [counters["count"]])
        elif _is_dump(path):  # as it was written before, in memory maps
            if counters["count"]:
                found = read_memory_maps(path / "rows")
                _require_rows(found, counters["count"], path)
                rows = TensorDict(found, [counters["count"]])
        else:
            raise ValueError(
                f"{path / _META} is not a description of saved rows, or is damaged. Use another copy of it."
            )
        return Dump(rows, counters)

    def _counters(self) -> dict[str, int]:
        return {
            "capacity": self.capacity,
            "count": len(self),
            "kept": self.kept,
            "cursor": self.cursor,
            "write_count": self.write_count,
        }

    def restore(self, dump: Dump) -> None:
        """Take over rows and counters."""
        rows, counters = dump
        self.empty()
        self.kept = 0
        if counters["capacity"] != self.capacity:
            self.set_storage(self._make_storage(counters["capacity"]))
            self.set_writer(TensorDictRoundRobinWriter())
        for start in range(0, counters["count"], _CHUNK):
            assert rows is not None
            self.extend(rows[start : start + _CHUNK])
        self.kept = counters.get("kept", 0)  # of an earlier version: all was one ring
        self._set_writer(counters["cursor"], counters["write_count"])


def _require_rows(found: dict[tuple[str, ...], Tensor], count: int, path: Path) -> None:
    for key, value in found.items():
        if value.ndim == 0 or len(value) != count:
            raise ValueError(
                f"{path / _META} promises {count} rows, where {'.'.join(key)} has {list(value.shape)}: it is damaged. "
                "Use another copy of the folder."
            )


def require_own(folder: Path, is_ours: Callable[[Path], bool]) -> None:
    """Raise ``FileExistsError`` for a folder with files that are not a store's to remove."""
    if folder.exists() and (not folder.is_dir() or (any(folder.iterdir()) and not is_ours(folder))):
        raise FileExistsError(
            f"{folder} holds files that are not a replay buffer's to remove. Choose another folder, or empty it first."
        )


def _clear(folder: Path, is_ours: Callable[[Path], bool]) -> None:
    """Remove what an earlier store has left; refuse to remove anything else."""
    require_own(folder, is_ours)
    if folder.exists():
        shutil.rmtree(folder)


def _is_scratch(folder: Path) -> bool:
    """Whether a store kept its rows here while it was in use; what ``dumps`` saved is none, nor is any memory map."""
    return (folder / _SCRATCH).is_file()


def _is_dump(folder: Path) -> bool:
    """Whether ``dumps`` wrote this."""
    try:
        return {"cursor", "write_count", "count", "capacity"} <= set(load_json(folder / _META, ""))
    except (OSError, ValueError):
        return False
