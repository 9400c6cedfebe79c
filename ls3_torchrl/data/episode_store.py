"""Observations and the transitions between them, in two stores that keep together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ls3_torchrl._checks import require_at_least
from ls3_torchrl.data.arrays import require_checksum, with_checksum
from ls3_torchrl.data.stores import RowStore, require_own
from ls3_torchrl.files import load_json, new_folder, save_json_atomically

_DESCRIPTION = "buffer.json"
VERSION = 2


class EpisodeStore:
    """The frames of episodes, each stored once, and their transitions, which know their frames by number.

    An episode of T transitions has T + 1 frames. Frames are numbered as they are written, and transitions keep the
    number of their first one under ``frame``.

    Args:
        capacity: transitions that there is room for; the oldest are overwritten, but not those of :meth:`keep`.
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
        self.frames = RowStore(room, folder=folders[0], device=device)
        self.transitions = RowStore(capacity, folder=folders[1], device=device)
        self._frames_written = 0
        # The ring of frames begins with the one whose number is its slot plus this.
        self._shift = 0

    @property
    def frame_capacity(self) -> int:
        """Frames that there is room for now."""
        return self.frames.capacity

    def require_room_for(self, kept: Iterable[int], others: Iterable[int]) -> None:
        """Raise ``ValueError`` for an episode that is too long for what may be overwritten.

        Args:
            kept: lengths of episodes that will be kept, in their order.
            others: lengths of episodes that come after them.
        """
        held, held_frames = self.transitions.kept, self.frames.kept
        for steps in kept:
            self._require_room(steps, held, held_frames)
            held, held_frames = held + steps, held_frames + steps + 1
        for steps in others:
            self._require_room(steps, held, held_frames)

    def _require_room(self, steps: int, held: int, held_frames: int) -> None:
        too_many_frames = not self._grows and steps + 1 > self.frame_capacity - held_frames
        if steps > self.capacity - held or too_many_frames:
            offline = f", of which {held} and {held_frames} hold offline data, which are kept" if held else ""
            raise ValueError(
                f"An episode of {steps} steps does not fit a buffer of {self.capacity} transitions and "
                f"{self.frame_capacity} frames{offline}. Raise {'frame_capacity' if too_many_frames else 'capacity'}."
            )

    @property
    def keeps_all(self) -> bool:
        """Whether :meth:`keep` was called after all that was written."""
        return self.transitions.kept == self.transitions.write_count

    def keep(self) -> None:
        """Never overwrite what was written so far."""
        self.frames.keep()
        self.transitions.keep()

    def write(self, frames: TensorDictBase, rows: TensorDictBase) -> Tensor:
        """Write an episode's frames ``[T + 1]`` and transitions ``[T]``; returns rows, int64 ``[T]``."""
        steps = len(rows)
        self._make_room(steps)
        rows.set("frame", self._frames_written + torch.arange(steps).unsqueeze(-1))
        self.frames.extend(frames)
        self._frames_written += steps + 1
        return self.transitions.extend(rows)

    def _make_room(self, steps: int) -> None:
        """Let the ring of frames grow where an episode would overwrite frames of transitions that stay."""
        written, kept = self.transitions.write_count, self.transitions.kept
        # Number of the oldest transition that stays, of those that may be overwritten.
        oldest = kept + max(written + steps - self.capacity, 0)
        if not self._grows:
            return
        frame = self._frames_written
        if oldest < written:
            slot = self.transitions.later(torch.tensor(kept), oldest - kept)
            frame = int(self.transitions.storage[slot]["frame"])
        needed = self.frames.kept + self._frames_written + steps + 1 - frame
        if needed > self.frame_capacity:
            self._shift = self._frames_written - len(self.frames)
            # Two frames for each transition are enough even where all episodes have one step.
            self.frames.grow(min(max(needed, self.frame_capacity * 3 // 2), 2 * self.capacity))

    def slots(self, frame: Tensor) -> tuple[Tensor, Tensor]:
        """Where frames of these numbers and those after them lie, ``[B]`` each.

        Raises:
            RuntimeError: when they were overwritten.
        """
        frame, kept = frame.flatten(), self.frames.kept
        oldest = self._frames_written - len(self.frames) + kept  # of those that may be overwritten
        gone = frame[(frame >= kept) & (frame < oldest)]
        if len(gone):
            first = int(gone.min())
            raise RuntimeError(
                f"Frames older than number {oldest} were overwritten, but transitions still need frame {first}. Give "
                f"the buffer a larger frame_capacity (now {self.frame_capacity}), or None for as many as are needed."
            )
        slot = torch.where(frame < kept, frame, self.frames.later(frame.clamp(min=kept), -self._shift))
        return slot, self.frames.later(slot, 1)

    def state_dict(self) -> dict[str, Any]:
        """A copy of both rings and the counters."""
        rings = {"frames": self.frames.state_dict(), "transitions": self.transitions.state_dict()}
        return {**rings, "counters": self._counters()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over both rings and the counters."""
        self.frames.load_state_dict(state_dict["frames"])
        self.transitions.load_state_dict(state_dict["transitions"])
        self._set_counters(state_dict["counters"])

    def dumps(self, path: str | Path, description: dict[str, Any]) -> None:
        """Write both rings, the counters and a description to the folder ``path``; what was there stays until then.

        Raises:
            ValueError: for the ``scratch_dir``.
            FileExistsError: where other files lie in the way.
        """
        path = Path(path)
        if self.scratch_dir is not None and path.resolve() == self.scratch_dir.resolve():
            raise ValueError(f"{path} is the buffer's scratch_dir. Choose another folder to save to.")
        require_own(path, _is_dump)
        with new_folder(path, replace=True) as new:
            self.frames.dumps(new / "frames")
            self.transitions.dumps(new / "transitions")
            # Last: a folder with it is whole.
            save_json_atomically(
                with_checksum({**description, "counters": self._counters(), "version": VERSION}), new / _DESCRIPTION
            )

    @staticmethod
    def description(path: str | Path) -> dict[str, Any]:
        """What was written beside the rings.

        Raises:
            FileNotFoundError: when the folder holds no whole store.
            ValueError: when it is damaged.
        """
        file = Path(path) / _DESCRIPTION
        if not file.is_file():
            raise FileNotFoundError(f"{path} holds no saved buffer: {_DESCRIPTION} is missing. Save one with dumps().")
        found = load_json(file, "a description of a saved buffer")
        if found.get("version", 1) == VERSION:
            require_checksum(found, file)
        if not isinstance(found.get("counters"), dict) or {"frames_written", "shift"} - set(found["counters"]):
            raise ValueError(f"{file} is not a description of a saved buffer, or is damaged. Use another copy of it.")
        return found

    def loads(self, path: str | Path) -> None:
        """Take over both rings and the counters; where that fails, the store stays as it was."""
        counters, path = self.description(path)["counters"], Path(path)
        frames, transitions = self.frames.read(path / "frames"), self.transitions.read(path / "transitions")
        self.frames.restore(frames)
        self.transitions.restore(transitions)
        self._set_counters(counters)

    def _counters(self) -> dict[str, int]:
        return {"frames_written": self._frames_written, "shift": self._shift}

    def _set_counters(self, counters: Mapping[str, int]) -> None:
        self._frames_written, self._shift = counters["frames_written"], counters["shift"]


def _is_dump(folder: Path) -> bool:
    """Whether ``dumps`` wrote this, or what an earlier version wrote was cut off."""
    return (folder / _DESCRIPTION).is_file() or {p.name for p in folder.iterdir()} <= {"frames", "transitions"}
