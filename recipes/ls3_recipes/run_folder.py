"""A run's folder: settings, versions, metrics, episodes, agents, state, summary."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from ls3_recipes.run_files import require_new
from ls3_recipes.run_logger import RunLogger
from ls3_recipes.versions import description
from ls3_torchrl.files import PARTIAL, new_folder, save_atomically, save_json_atomically, save_text_atomically
from ls3_torchrl.trainers import Checkpoints, DivergenceError

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]


#: Updates whose agents are kept of a long run.
AGENTS = 100


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
        self.states = Checkpoints(self.path / "checkpoints")
        self.logger = RunLogger(self.path)

    @classmethod
    def make(cls, path: str | Path, settings: Mapping[str, Any]) -> RunFolder:
        """A new one, with the run's settings.

        Raises:
            FileExistsError: when the folder exists.
        """
        with new_folder(require_new(path)) as new:  # with both files or not at all
            save_text_atomically(OmegaConf.to_yaml(OmegaConf.create(dict(settings))), new / "config.yaml")
            save_json_atomically(description(settings.get("data")), new / "versions.json")
        return cls(path)

    def tidy(self) -> None:
        """Remove what a process that was killed had begun to write."""
        for path in sorted(self.path.rglob(f".*{PARTIAL}")):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        self.states.tidy()

    def thin_out_agents(self, updates: int, *others: int) -> None:
        """Keep the agents of at most :data:`AGENTS` updates, evenly spaced, and others by number.

        Args:
            updates: of the whole run.
            others: updates whose agents stay.
        """
        interval = -(-updates // AGENTS)
        for path in (self.path / "checkpoints").glob("agent_*.pt"):
            number = path.stem.removeprefix("agent_")
            if number.isdecimal() and int(number) % interval and int(number) not in others:
                path.unlink()

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

    def keep_divergence(self, error: DivergenceError, state: dict[str, Any]) -> Path:
        """Keep what training diverged on, for a look, and return where; the state that was saved last stays."""
        path = self.path / "diverged"
        save_json_atomically({"error": str(error), "phase": error.phase, "step": error.step}, path / "error.json")
        batch = None if error.batch is None else error.batch.to_dict()
        save_atomically({"batch": batch, "state": state}, path / "state.pt")
        return path

    def close(self) -> None:
        """Flush and close what is open, and leave the folder to others."""
        try:
            self.logger.close()
        finally:
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
        while not self._is_held():  # its holder has removed it in between
            self._file.close()
            self._file = path.open("a")

    def _is_held(self) -> bool:
        """Whether the file is locked now, and still is the one at the path."""
        if fcntl is None:  # on Windows nothing is locked
            return True
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise FileExistsError(
                f"Another process is writing to {self._path.parent}. Wait for it, stop it, or choose another "
                "output=DIR."
            ) from None
        except OSError:  # a file system without locks
            return True
        return self._path.exists() and os.path.samestat(self._path.stat(), os.fstat(self._file.fileno()))

    def release(self) -> None:
        """Let others in."""
        self._path.unlink(missing_ok=True)
        self._file.close()
