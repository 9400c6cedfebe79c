"""A TorchRL replay buffer whose ring of rows can grow, be memory-mapped, and be saved without its unused room."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer, TensorDictRoundRobinWriter
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.data.replay_buffers.storages import Storage

from ls3_torchrl.data.arrays import keys_of, read_arrays, write_arrays
from ls3_torchrl.files import allocate, new_folder, read_json, save_json_atomically

#: Rows that are copied at a time where all of them might not fit into memory.
_CHUNK = 1024
_COUNTERS = ("capacity", "count", "cursor", "write_count")
#: Marks a folder that a store made for its own use.
_SCRATCH = "scratch.txt"


class RowStore(TensorDictReplayBuffer):
    """Rows in a ring: where it is full, the oldest are overwritten.

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
        OSError: on the first write, when the disk has too little space for ``capacity`` rows.

    Example:
        >>> store = RowStore(2)
        >>> _ = store.extend(TensorDict({"x": torch.arange(3).unsqueeze(-1)}, [3]))
        >>> store.storage[:]["x"].flatten().tolist()
        [2, 1]
        >>> store.grow(4)
        >>> store.storage[:]["x"].flatten().tolist()
        [1, 2]
    """

    def __init__(self, capacity: int, *, folder: str | Path | None = None, device: torch.device | str = "cpu") -> None:
        self._folder = None if folder is None else Path(folder)
        self._device = torch.device(device)
        super().__init__(
            storage=self._make_storage(capacity), sampler=RandomSampler(), writer=TensorDictRoundRobinWriter()
        )

    def _make_storage(self, capacity: int) -> Storage:
        if self._folder is None:
            return LazyTensorStorage(capacity, device=self._device)
        return _AllocatedStorage(capacity, scratch_dir=str(self._folder))

    @property
    def capacity(self) -> int:
        """Rows that there is room for."""
        return self.storage.max_size

    @property
    def cursor(self) -> int:
        """Where the next row will be written."""
        return self.writer.state_dict()["_cursor"]

    def prepare(self, rows: TensorDictBase) -> None:
        """Make the room on disk for rows like these ``[n]``: what can fail fails before a write."""
        if self._folder is None or self.storage.initialized or len(rows) == 0:
            return
        _clear(self._folder, _is_scratch)
        self._folder.mkdir(parents=True, exist_ok=True)
        note = "A replay buffer's memory while it is in use; it can be removed.\n"
        (self._folder / _SCRATCH).write_text(note, encoding="utf-8")
        with torch.inference_mode(False), torch.no_grad():
            one = rows[:1].detach().copy().set("index", torch.zeros(1, dtype=torch.int64))
            self.storage._init(one[0])

    def extend(self, rows: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Write rows ``[n]``; returns where, int64 ``[n]``."""
        self.prepare(rows)
        # Else a store that is first written under inference_mode() could never be written outside of it.
        with torch.inference_mode(False), torch.no_grad():
            return super().extend(rows.detach(), update_priority=update_priority)

    def grow(self, capacity: int) -> None:
        """Make room for more rows: from the oldest on they lie in their order, the first one at 0."""
        old, count, start = self.storage, len(self), self.cursor if len(self) == self.capacity else 0
        written, writer = self.write_count, self.writer
        self.set_storage(self._make_storage(capacity))
        self.set_writer(TensorDictRoundRobinWriter())
        try:
            # A memory-mapped store writes to the folder that it reads from: its old files, although removed, stay
            # readable until the old storage is let go.
            for begin in range(0, count, _CHUNK):
                rows = torch.arange(begin, min(begin + _CHUNK, count), device=self._device) + start
                self.extend(old[rows % count])
        except OSError:  # the disk is full
            self.set_storage(old)
            self.set_writer(writer)
            raise
        self.writer.load_state_dict({"_cursor": count % capacity, "_write_count": written})

    def state_dict(self) -> dict[str, Any]:
        """A copy of the rows and the ring's counters, which ``torch.load(weights_only=True)`` can read."""
        rows = self.storage[:].clone().to_dict() if len(self) else {}
        return {"rows": rows, **self._counters()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the rows and counters of another store.

        Raises:
            ValueError: for what is no store's state, or has rows of another form; the store stays as it was.
        """
        self.restore(*self.checked(state_dict, "The state"))

    def dumps(self, path: str | Path) -> None:
        """Write the rows and counters below the folder ``path``, in the place of an earlier dump.

        Raises:
            FileExistsError: for a folder with other files.
            OSError: on a full disk; names the file, and nothing half-written is left.
        """
        path = Path(path)
        _clear(path, is_dump)
        if path.exists():
            path.rmdir()
        with new_folder(path) as folder:
            if len(self):
                (folder / "rows").mkdir()
                rows = self.storage[:]
                write_arrays(folder / "rows", {key: [rows.get(key)] for key in keys_of(rows)}, [len(self)])
            save_json_atomically(self._counters(), folder / "meta.json")

    def loads(self, path: str | Path) -> None:
        """Take over rows and counters from the folder ``path``; no pickles are read, and nothing is written there.

        Raises:
            FileNotFoundError, ValueError: for missing or damaged files, which are named; the store stays as it was.
        """
        self.restore(*self.checked(self.read(path), str(path)))

    @staticmethod
    def read(path: str | Path, *, remedy: str = "Save the buffer again.") -> dict[str, Any]:
        """What :meth:`dumps` has written, as :meth:`state_dict` gives it."""
        path = Path(path)
        counters = read_json(path / "meta.json", remedy=remedy)
        rows = read_arrays(path / "rows", remedy=remedy) if counters.get("count") != 0 else {}
        state: dict[str, Any] = {}
        for key, value in rows.items():
            group = state
            for part in key[:-1]:
                group = group.setdefault(part, {})
            group[key[-1]] = value
        return {"rows": state, **counters}

    def checked(self, state_dict: Any, name: str) -> tuple[TensorDict | None, dict[str, int]]:
        """Rows and counters of a state, when they can be restored.

        Raises:
            ValueError: otherwise; ``name`` says what is wrong.
        """
        if not isinstance(state_dict, Mapping) or not {"rows", *_COUNTERS} <= set(state_dict):
            raise ValueError(f"{name} is no replay buffer's: it lacks rows or counters. Save the buffer again.")
        counters = {key: state_dict[key] for key in _COUNTERS}
        capacity, count, cursor, written = counters.values()
        whole = all(type(value) is int for value in counters.values())
        if not whole or not (capacity >= 1 and 0 <= count <= capacity and 0 <= cursor < capacity and written >= count):
            raise ValueError(f"{name} is damaged: its counters are {counters}. Save the buffer again.")
        if count == 0:
            return None, counters
        try:
            rows = TensorDict(state_dict["rows"], [count])
            lengths = {len(rows.get(key)) for key in keys_of(rows) if isinstance(rows.get(key), Tensor)}
        except (RuntimeError, TypeError, ValueError) as error:
            raise ValueError(f"{name} is damaged: its rows are not {count} in all entries ({error}).") from error
        if lengths != {count}:
            raise ValueError(f"{name} is damaged: its rows are not {count} in all entries. Save the buffer again.")
        if self.storage.initialized:
            _require_form(rows, self.storage[:], name)
        return rows, counters

    def restore(self, rows: TensorDictBase | None, counters: dict[str, int]) -> None:
        """Take over rows and counters that :meth:`checked` has let through."""
        self.empty()
        if counters["capacity"] != self.capacity:
            self.set_storage(self._make_storage(counters["capacity"]))
            self.set_writer(TensorDictRoundRobinWriter())
        for start in range(0, counters["count"], _CHUNK):
            assert rows is not None
            self.extend(rows[start : start + _CHUNK])
        self.writer.load_state_dict({"_cursor": counters["cursor"], "_write_count": counters["write_count"]})

    def _counters(self) -> dict[str, int]:
        return {
            "capacity": self.capacity,
            "count": len(self),
            "cursor": self.cursor,
            "write_count": self.write_count,
        }


class _AllocatedStorage(LazyMemmapStorage):
    """Takes its space on disk when it is made: a full disk is an error then, and does not kill the process later."""

    def _init(self, data: TensorDictBase) -> None:
        super()._init(data)
        try:
            for file in Path(self.scratch_dir).rglob("*.memmap"):
                allocate(file)
        except OSError:
            self._storage, self.initialized = None, False
            raise


def _require_form(rows: TensorDictBase, own: TensorDictBase, name: str) -> None:
    """Raise ``ValueError`` where rows have other entries than those that there is room for."""
    mine, others = ({key: (x.get(key).shape[1:], x.get(key).dtype) for key in keys_of(x)} for x in (rows, own))
    for key in sorted(mine.keys() | others.keys(), key=str):
        if mine.get(key) != others.get(key):
            raise ValueError(
                f"{name} has rows with {key} of {mine.get(key)}, but the buffer already held rows with "
                f"{others.get(key)} there (shape, dtype). Load into a new buffer."
            )


def _clear(folder: Path, is_ours: Callable[[Path], bool]) -> None:
    """Remove what an earlier store has left; refuse to remove anything else."""
    if not folder.exists() or not any(folder.iterdir()):
        return
    if not is_ours(folder):
        raise FileExistsError(
            f"{folder} holds files that are not a replay buffer's to remove. Choose another folder, or empty it first."
        )
    shutil.rmtree(folder)


def _is_scratch(folder: Path) -> bool:
    """Whether a store kept its rows here while it was in use; what ``dumps`` saved is none, nor is any memory map."""
    return (folder / _SCRATCH).is_file()


def is_dump(folder: Path) -> bool:
    """Whether ``dumps`` wrote this."""
    try:
        return {"cursor", "write_count"} <= set(read_json(folder / "meta.json"))
    except (OSError, ValueError):
        return False
