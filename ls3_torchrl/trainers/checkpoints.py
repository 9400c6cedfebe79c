"""States of training on disk, from which it continues: TorchRL's checkpoints, made safe against what ends a process."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from torchrl.checkpoint import Checkpoint, CheckpointRotation, StateDictCheckpointAdapter

from ls3_torchrl._checks import DataWarning
from ls3_torchrl.files import is_full, sync_folder

#: Checkpoints kept: the newest, and the one before for when the newest is damaged.
KEPT = 2
#: How the name of a file ends that was found damaged.
DAMAGED = ".damaged"


class Stateful(Protocol):
    """What has a state."""

    def state_dict(self) -> dict[str, Any]:
        """The state, as ``torch.load(weights_only=True)`` can read it."""

    def load_state_dict(self, state_dict: dict[str, Any], /) -> Any:
        """Take a state over."""


class Checkpoints:
    """Whole states of training, the newest two, in files that are whole or not there.

    TorchRL's :class:`~torchrl.checkpoint.CheckpointRotation` names, writes and removes them. Here they are forced to
    the disk, what a killed process left behind is removed, a damaged file gives way to the one before it, and a full
    disk is called by its name. Every file is a ZIP archive whose checksums are verified; no code in it is run.

    Args:
        folder: where they lie, and no one else's files named ``run-*``.

    Example:
        >>> import tempfile
        >>> import torch
        >>> net, other = torch.nn.Linear(2, 1), torch.nn.Linear(2, 1)
        >>> checkpoints = Checkpoints(tempfile.mkdtemp())
        >>> checkpoints.save({"net": net})
        >>> checkpoints.load({"net": other})
        True
        >>> bool((net.weight == other.weight).all())
        True
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._rotation = CheckpointRotation(self.folder, keep_last=KEPT, prefix="run")

    def save(self, parts: Mapping[str, Stateful]) -> None:
        """Write the state of all parts; the file before stays until this one is on the disk.

        Args:
            parts: by name: networks, trainers, replay buffers, :class:`~torchrl.checkpoint.GlobalRNGState`, and
                whatever else has a state.

        Raises:
            OSError: when there is no room, naming the folder; what was saved before stays.
        """
        there = self._rotation.checkpoints()
        step = int(there[-1].stem.rpartition("-")[2]) + 1 if there else 1
        try:
            path = self._rotation.save(_checkpoint(parts), step=step)
            _sync(path)
            sync_folder(self.folder)
        except (OSError, RuntimeError) as error:
            if is_full(error, self.folder):
                kept = "the one saved before is whole" if self.exist() else "none was saved before"
                said = f"No space left on device: the state could not be saved; {kept}"
                raise OSError(errno.ENOSPC, said, str(self.folder)) from error
            raise

    def load(self, parts: Mapping[str, Stateful]) -> bool:
        """Give all parts the newest state that is whole.

        Args:
            parts: those that were saved.

        Returns:
            Whether there was one.

        Raises:
            ValueError: when there are files, and none is whole.

        Warns:
            DataWarning: when the newest one is damaged, and the one before is taken.
        """
        self.tidy()
        damaged: dict[Path, str] = {}
        for path in reversed(self._files()):
            states = {name: _Held() for name in parts}
            try:
                _checkpoint(states).load(path)
            except MemoryError:
                raise
            except Exception as error:  # whatever damage makes of a file
                if is_full(error, unpacked := Path(tempfile.gettempdir())):
                    said = "No space left on device, where the state is unpacked; make room or set TMPDIR"
                    raise OSError(errno.ENOSPC, said, str(unpacked)) from error
                damaged[path] = f"{path} cannot be read ({' '.join(str(error).split())[:200]})"
                continue
            for name, part in parts.items():  # when all of them are whole
                part.load_state_dict(states[name].state)
            for other, what in damaged.items():
                other.rename(other.with_suffix(DAMAGED))  # else it would be one of the two that are kept
                warnings.warn(f"{what}; continuing from {path.name}, the one before.", DataWarning, stacklevel=2)
            return True
        if damaged:
            raise ValueError(f"{'; '.join(damaged.values())}. No state is whole: start again in another folder.")
        return False

    def tidy(self) -> None:
        """Remove what a killed process left in the middle of a save."""
        for path in self.folder.glob(".run-*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def exist(self) -> bool:
        """Whether there is a state to continue from."""
        return bool(self._files())

    def remove(self) -> None:
        """Remove all: training is finished."""
        self.tidy()
        for path in [*self.folder.glob(f"run-*{DAMAGED}"), *self._files()]:
            path.unlink()

    def _files(self) -> list[Path]:
        """By name: also those whose beginning is damaged, which TorchRL passes over in silence."""
        return sorted(self.folder.glob("run-*.torchrl"))


class _Held:
    """Holds a state that was read."""

    def __init__(self) -> None:
        self.state: dict[str, Any] = {}

    def state_dict(self) -> dict[str, Any]:
        return self.state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.state = state_dict


def _checkpoint(parts: Mapping[str, Stateful]) -> Checkpoint:
    # In memory maps, which are the default, a full disk ends the process with SIGBUS.
    adapter = StateDictCheckpointAdapter(payload_format="torch")
    checkpoint = Checkpoint(format="archive")
    for name, part in parts.items():
        checkpoint.register(name, part, adapter=adapter)
    return checkpoint


def _sync(path: Path) -> None:
    """Force a file to the disk."""
    handle = os.open(path, os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
