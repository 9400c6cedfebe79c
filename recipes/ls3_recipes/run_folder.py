"""A run's folder: settings, versions, metrics, episodes, agents, state, summary."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

from omegaconf import OmegaConf

from ls3_recipes.checkpoints import RunCheckpoints
from ls3_recipes.run_files import require_new
from ls3_recipes.run_logger import RunLogger
from ls3_recipes.versions import description
from ls3_torchrl.files import save_json_atomically, save_text_atomically

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]


class RunFolder:
    """What a run leaves: settings, versions, metrics, online episodes, agents and, until it is finished, its state.

    Args:
        path: of a folder that :meth:`make` has made.

    Raises:
        FileExistsError: while another process writes to it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._lock = Lock(self.path / "lock")
        self.states = RunCheckpoints(self.path / "checkpoints")
        self.logger = RunLogger(self.path)

    @classmethod
    def make(cls, path: str | Path, settings: Mapping[str, Any]) -> RunFolder:
        """A new one, with the run's settings.

        Raises:
            FileExistsError: when the folder exists.
        """
        path = require_new(path)
        new = path.with_name(f".{path.name}.{uuid4().hex}")  # in one go: a folder with these files or none
        new.mkdir(parents=True)
        save_text_atomically(OmegaConf.to_yaml(OmegaConf.create(dict(settings))), new / "config.yaml")
        save_json_atomically(description(), new / "versions.json")
        try:
            new.rename(path)
        except OSError:  # another run has made it meanwhile
            shutil.rmtree(new)
            require_new(path)
            raise
        return cls(path)

    @property
    def minutes(self) -> float:
        """Minutes that the run has taken so far."""
        return round(self.logger.seconds / 60, 2)

    def agent(self, update: int) -> Path:
        """Where the agent is kept after ``update`` updates."""
        return self.path / "checkpoints" / f"agent_{update:03d}.pt"

    def episodes(self, update: int) -> Path:
        """Where the online episodes before an update are kept."""
        return self.path / "episodes" / f"update_{update:03d}"

    def write_json(self, name: str, content: dict) -> Path:
        """Write a JSON file in one go: a half-written file never takes its place."""
        return save_json_atomically(content, self.path / name)

    def close(self) -> None:
        """Flush and close what is open, and leave the folder to others."""
        self.logger.close()
        self._lock.release()


class Lock:
    """Keeps a second process out of a folder; the system lets go of it when the process ends, however it ends.

    Args:
        path: of the file that is locked; it is removed by :meth:`release`.

    Raises:
        FileExistsError: while another process holds it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("a")
        if fcntl is None:  # on Windows nothing is locked
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise FileExistsError(
                f"Another process is writing to {path.parent}. Wait for it, stop it, or choose another output=DIR."
            ) from None

    def release(self) -> None:
        """Let others in."""
        self._path.unlink(missing_ok=True)
        self._file.close()
