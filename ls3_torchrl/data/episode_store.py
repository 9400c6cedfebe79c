"""Observations and the transitions between them, in two rings that keep together."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ls3_torchrl._checks import require_at_least
from ls3_torchrl.data.stores import RowStore, is_dump
from ls3_torchrl.files import (
    PARTIAL,
    checksum_of,
    file_manifest,
    inner_path,
    new_folder,
    read_json,
    save_json_atomically,
    verify_files,
)

_DESCRIPTION = "buffer.json"
VERSION = 2
_CONTENT = "content-"
_REMEDY = "Restore the folder from a copy, or save the buffer again with dumps()."


class EpisodeStore:
    """The frames of episodes, each stored once, and their transitions, which know their frames by number.

    An episode of T transitions has T + 1 frames. Frames are numbered as they are written, and transitions keep the
    number of their first one under ``frame``.

    Args:
        capacity: transitions kept; the oldest are overwritten.
        frame_capacity: frames kept; ``None`` keeps at least those of all transitions kept: room for episodes of 16
            steps, and more as soon as there are shorter ones.
        scratch_dir: memory-map both rings in the folders ``frames`` and ``transitions`` below this one.
        device: where rings in memory live.

    Example:
        >>> from tensordict import TensorDict
        >>> store = EpisodeStore(100)
        >>> frames = TensorDict({"state": torch.arange(4.0).unsqueeze(-1)}, [4])
        >>> rows = TensorDict({"action": torch.zeros(3, 2)}, [3])
        >>> store.write(frames, rows).tolist(), rows["frame"].flatten().tolist()
        ([0, 1, 2], [0, 1, 2])
    """

    def __init__(
        self,
        capacity: int,
        *,
        frame_capacity: int | None = None,
        scratch_dir: str | Path | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.capacity = require_at_least(capacity, 1, "capacity")
        self._grows = frame_capacity is None
        room = capacity + capacity // 16 + 64 if frame_capacity is None else frame_capacity
        require_at_least(room, 2, "frame_capacity")
        folders = [None if scratch_dir is None else Path(scratch_dir) / name for name in ("frames", "transitions")]
        self.scratch_dir = None if scratch_dir is None else Path(scratch_dir)
        if self.scratch_dir is not None and (self.scratch_dir / _DESCRIPTION).exists():
            raise FileExistsError(
                f"The scratch_dir {scratch_dir} holds a saved buffer, which is not a replay buffer's to remove. Choose "
                "another folder; loads() goes on with what was saved."
            )
        self.frames = RowStore(room, folder=folders[0], device=device)
        self.transitions = RowStore(capacity, folder=folders[1], device=device)
        self._frames_written = 0
        # Frame number n lies in slot (n - shift) % frame_capacity.
        self._shift = 0

    @property
    def frame_capacity(self) -> int:
        """Frames that there is room for now."""
        return self.frames.capacity

    def require_room(self, steps: int) -> None:
        """Raise ``ValueError`` when an episode of so many steps is too long."""
        if steps + 1 > self.frame_capacity or steps > self.capacity:
            raise ValueError(
                f"An episode of {steps} steps does not fit a buffer of {self.capacity} transitions and "
                f"{self.frame_capacity} frames. Raise capacity."
            )

    def write(self, frames: TensorDictBase, rows: TensorDictBase) -> Tensor:
        """Write an episode's frames ``[T + 1]`` and transitions ``[T]``; returns rows, int64 ``[T]``."""
        steps = len(rows)
        self._make_room(steps)
        rows.set("frame", self._frames_written + torch.arange(steps).unsqueeze(-1))
        self.transitions.prepare(rows)  # before frames are written that nothing would belong to
        self.frames.extend(frames)
        self._frames_written += steps + 1
        return self.transitions.extend(rows)

    def _make_room(self, steps: int) -> None:
        """Let the ring of frames grow where an episode would overwrite frames of transitions that stay."""
        written = self.transitions.write_count
        oldest = max(written + steps - self.capacity, 0)  # number of the oldest transition that stays
        if not self._grows or oldest >= written:
            return
        frame = int(self.transitions.storage[oldest % self.capacity]["frame"])
        needed = self._frames_written + steps + 1 - frame
        if needed > self.frame_capacity:
            self._shift = self._frames_written - len(self.frames)
            # Two frames for each transition are enough even where all episodes have one step.
            self.frames.grow(min(max(needed, self.frame_capacity * 3 // 2), 2 * self.capacity))

    def slots(self, frame: Tensor) -> tuple[Tensor, Tensor]:
        """Where frames of these numbers and those after them lie, ``[B]`` each.

        Raises:
            RuntimeError: when they were overwritten.
        """
        oldest, first = self._frames_written - len(self.frames), int(frame.min())
        if first < oldest:
            raise RuntimeError(
                f"Frames older than number {oldest} were overwritten, but transitions still need frame {first}. Give "
                f"the buffer a larger frame_capacity (now {self.frame_capacity}), or None for as many as are needed."
            )
        slot = (frame.flatten() - self._shift) % self.frame_capacity
        return slot, (slot + 1) % self.frame_capacity

    def state_dict(self) -> dict[str, Any]:
        """A copy of both rings and the counters."""
        rings = {"frames": self.frames.state_dict(), "transitions": self.transitions.state_dict()}
        return {**rings, "counters": self._counters()}

    def load_state_dict(self, state_dict: Mapping[str, Any], name: str = "The state") -> None:
        """Take over both rings and the counters.

        Raises:
            ValueError: for what is no store's state, or damaged; ``name`` says what, and the store stays as it was.
        """
        if not isinstance(state_dict, Mapping) or not {"frames", "transitions", "counters"} <= set(state_dict):
            raise ValueError(f"{name} is no replay buffer's: it lacks frames, transitions or counters.")
        frames = self.frames.checked(state_dict["frames"], f"{name}, frames,")
        transitions = self.transitions.checked(state_dict["transitions"], f"{name}, transitions,")
        counters = state_dict["counters"]
        written = counters.get("frames_written") if isinstance(counters, Mapping) else None
        if type(written) is not int or type(counters.get("shift")) is not int or written < frames[1]["count"]:
            raise ValueError(f"{name} is damaged: its counters are {counters!r}. {_REMEDY}")
        if transitions[0] is not None:
            number = transitions[0].get("frame", None)
            if number is None or number.shape != (len(transitions[0]), 1) or number.dtype != torch.int64:
                raise ValueError(f"{name} is damaged: its transitions do not tell their frames. {_REMEDY}")
            if int(number.min()) < 0 or int(number.max()) + 1 >= written:
                raise ValueError(f"{name} is damaged: its transitions tell of frames that there are not. {_REMEDY}")
        self.frames.restore(*frames)
        self.transitions.restore(*transitions)
        self._frames_written, self._shift = counters["frames_written"], counters["shift"]

    def dumps(self, path: str | Path, description: dict[str, Any]) -> None:
        """Write both rings, the counters and a description below the folder ``path``, in the place of earlier ones.

        The description is written last and names the folder that holds the rest, with the size and checksum of every
        file: where writing is cut off, what was there before is whole.

        Raises:
            ValueError: for the ``scratch_dir``.
            FileExistsError: for a folder with a ``buffer.json`` of something else.
            OSError: on a full disk; names the file, and what was there before is whole.
        """
        path = Path(path)
        if self.scratch_dir is not None and path.resolve() == self.scratch_dir.resolve():
            raise ValueError(f"{path} is the buffer's scratch_dir. Choose another folder to save to.")
        _require_ours(path / _DESCRIPTION)
        content = f"{_CONTENT}{uuid.uuid4().hex[:12]}"
        with new_folder(path / content) as folder:
            self.frames.dumps(folder / "frames")
            self.transitions.dumps(folder / "transitions")
        about = {
            **description,
            "counters": self._counters(),
            "version": VERSION,
            "content": content,
            "files": file_manifest(path / content),
        }
        save_json_atomically(
            {**about, "checksum": checksum_of(about)}, path / _DESCRIPTION
        )  # a folder with it is whole
        _remove_earlier(path, content)

    @staticmethod
    def description(path: str | Path) -> dict[str, Any]:
        """What was written beside the rings.

        Raises:
            FileNotFoundError: when the folder holds no whole store.
            ValueError: when the description is damaged.
        """
        file = Path(path) / _DESCRIPTION
        if not file.is_file():
            raise FileNotFoundError(f"{path} holds no saved buffer: {_DESCRIPTION} is missing. Save one with dumps().")
        about = read_json(file, remedy=_REMEDY)
        version = about.get("version", 1)
        if version not in (1, VERSION):
            raise ValueError(f"{file} is of version {version!r}, but 1 and {VERSION} are read. {_REMEDY}")
        if version == 1 and {"content", "files", "checksum"} & set(about):
            raise ValueError(f"{file} is damaged: it has entries that its version 1 has not. {_REMEDY}")
        if version == VERSION and about.pop("checksum", None) != checksum_of(about):
            raise ValueError(f"{file} is damaged, or was edited: its checksum is another. {_REMEDY}")
        return about

    def read(self, path: str | Path) -> dict[str, Any]:
        """What :meth:`dumps` has written, checked and as :meth:`state_dict` gives it. Nothing is run, nothing written.

        Raises:
            FileNotFoundError, ValueError: for missing or damaged files, which are named.
        """
        path, about = Path(path), self.description(path)
        folder = path
        if "files" in about:
            folder = inner_path(path, about.get("content"))
            verify_files(folder, about["files"], remedy=_REMEDY)
        rings = {name: RowStore.read(folder / name, remedy=_REMEDY) for name in ("frames", "transitions")}
        return {**rings, "counters": about.get("counters")}

    def loads(self, path: str | Path) -> None:
        """Take over what :meth:`dumps` has written."""
        self.load_state_dict(self.read(path), str(path))

    def _counters(self) -> dict[str, int]:
        return {"frames_written": self._frames_written, "shift": self._shift}


def _require_ours(file: Path) -> None:
    """Raise ``FileExistsError`` when a description is there that no buffer wrote; a damaged one may be replaced."""
    try:
        ours = not file.exists() or "counters" in read_json(file)
    except ValueError:
        ours = True
    if not ours:
        raise FileExistsError(f"{file} is not a replay buffer's to replace. Choose another folder, or empty it first.")


def _remove_earlier(path: Path, content: str) -> None:
    """Remove what earlier saves have left, whole or not."""
    for child in path.iterdir():
        old = child.name.startswith(_CONTENT) and (child / "frames").is_dir() and child.name != content
        cut = child.name.startswith(_CONTENT) and child.name.endswith(PARTIAL)
        first = child.name in ("frames", "transitions") and (child / "meta.json").is_file() and is_dump(child)
        if child.is_dir() and (old or cut or first):
            shutil.rmtree(child, ignore_errors=True)
