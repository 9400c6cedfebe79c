"""A run's folder: settings, versions, metrics, checkpoints, summary; and the logger that fills it."""

from __future__ import annotations

import csv
import io
import json
import os
import platform
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from torchrl.record.loggers import Logger

from ls3_torchrl.files import save_json_atomically, save_text_atomically

PACKAGES = ("torch", "torchrl", "tensordict", "numpy", "mujoco", "mujoco-warp", "hydra-core", "ls3-torchrl")
#: Of ``metrics.csv``.
COLUMNS = ("seconds", "phase", "step", "name", "value")
#: Bytes that a file's name can have on all common file systems.
_LONGEST_NAME = 255


class RunLogger(Logger):
    """Writes scalars named ``phase/name`` to ``metrics.csv`` and to TensorBoard.

    Args:
        folder: the run's folder; ``metrics.csv`` and ``tensorboard/`` are made in it.

    Example:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> logger = RunLogger(folder)
        >>> logger.log_scalar("Safe set/loss_safe_set", 0.25, step=100)
        >>> logger.close()
        >>> [(row["phase"], row["step"], row["name"], row["value"]) for row in read_metrics(folder)]
        [('Safe set', '100', 'loss_safe_set', '0.25')]
    """

    def __init__(self, folder: str | Path) -> None:
        self._start = time.perf_counter()
        self._csv = (Path(folder) / "metrics.csv").open("w", newline="", encoding="utf-8")
        self._rows = csv.writer(self._csv)
        self._rows.writerow(COLUMNS)
        super().__init__(exp_name="tensorboard", log_dir=str(folder))

    def _create_experiment(self) -> SummaryWriter:
        return SummaryWriter(str(Path(self.log_dir) / self.exp_name))

    @property
    def seconds(self) -> float:
        """Seconds since the logger was made."""
        return time.perf_counter() - self._start

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """One metric; what stands before the last slash of its name is its phase."""
        phase, _, metric = name.rpartition("/")
        self._rows.writerow([f"{self.seconds:.1f}", phase, step, metric, f"{value:.6g}"])
        self._csv.flush()
        self.experiment.add_scalar(name, value, step)

    def log_video(self, name: str, video: Tensor, step: int | None = None, **options: Any) -> None:
        """A video ``[N, T, C, H, W]``, to TensorBoard."""
        self.experiment.add_video(name, video, global_step=step, **options)

    def log_hparams(self, cfg: Any) -> None:
        """Settings, to TensorBoard; the run's own are in ``config.yaml``."""
        self.experiment.add_text("settings", f"```yaml\n{OmegaConf.to_yaml(OmegaConf.create(cfg))}```")

    def log_histogram(self, name: str, data: Sequence, **options: Any) -> None:
        """A histogram, to TensorBoard."""
        self.experiment.add_histogram(name, data, options.get("step"))

    def close(self, timeout: float | None = None) -> None:
        """Write what is left, and close table and board."""
        self._csv.close()
        super().close(timeout)

    def __repr__(self) -> str:
        return f"RunLogger({self.log_dir!r})"


class RunFolder:
    """A run's folder: ``config.yaml``, ``versions.json``, ``metrics.csv``, ``tensorboard/``, ``checkpoints/``.

    Args:
        path: must not exist, so that no earlier run is ever overwritten.
        settings: the run's settings, written at once.

    Raises:
        FileExistsError: when the folder exists.
    """

    def __init__(self, path: str | Path, settings: Mapping[str, Any]) -> None:
        self.path = require_new(path)
        try:
            self.path.mkdir(parents=True)
        except FileExistsError:  # another run was quicker
            require_new(path)
            raise
        save_text_atomically(OmegaConf.to_yaml(OmegaConf.create(dict(settings))), self.path / "config.yaml")
        self.write_json("versions.json", versions())
        self.logger = RunLogger(self.path)

    @property
    def minutes(self) -> float:
        """Minutes since the folder was made."""
        return round(self.logger.seconds / 60, 2)

    def checkpoint(self, update: int) -> Path:
        """Where the agent is kept after ``update`` updates."""
        return self.path / "checkpoints" / f"agent_{update:03d}.pt"

    def write_json(self, name: str, content: dict) -> Path:
        """Write a JSON file in one go: a half-written file never takes its place."""
        return save_json_atomically(content, self.path / name)

    def close(self) -> None:
        """Flush and close what is open."""
        self.logger.close()


def require_new(path: str | Path) -> Path:
    """The path of an output folder that does not exist yet and can be made.

    Raises:
        FileExistsError: when it exists.
        ValueError: when it cannot be made.
    """
    path = Path(path)
    if os.path.lexists(path):
        raise FileExistsError(
            f"The output folder {path} exists already, and no run overwrites another. Choose another with output=DIR, "
            "or move the old one away."
        )
    require_writable(path, "output")
    return path


def require_writable(path: str | Path, name: str) -> None:
    """Refuse a file or folder that cannot be made, without making it.

    Args:
        path: of the file or folder.
        name: of the setting.

    Raises:
        ValueError: naming what is in the way.
    """
    parent = Path(path).absolute().parent
    while not os.path.lexists(parent) and parent != parent.parent:
        parent = parent.parent
    if not parent.is_dir():
        raise ValueError(f"{name}={path} cannot be made: {parent} is no folder. Choose another place.")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise ValueError(f"{name}={path} cannot be made: {parent} cannot be written to. Choose another place.")
    if any(len(os.fsencode(part)) > _LONGEST_NAME for part in Path(path).parts):
        raise ValueError(f"{name}={path} cannot be made: the name is too long. Choose a shorter one.")


def require_folder(path: str | Path, name: str) -> None:
    """Refuse a folder to work in that is no folder, or that cannot be written to or made.

    Args:
        path: of the folder; it may exist.
        name: of the setting.

    Raises:
        ValueError: naming what is in the way.
    """
    path = Path(path)
    if not os.path.lexists(path):
        require_writable(path, name)
    elif not path.is_dir() or not os.access(path, os.W_OK | os.X_OK):
        raise ValueError(f"{name}={path} is no folder that can be written to. Choose another place.")


def versions() -> dict[str, str]:
    """Versions of the packages that decide what a run does."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # run from a clone that is not installed
            found[name] = "not installed"
    return found


def read_metrics(folder: str | Path) -> list[dict[str, str]]:
    """The rows of a run's ``metrics.csv``; steps and values are numbers, NaN among them.

    Raises:
        FileNotFoundError: when there is none.
        ValueError: for a file that is damaged.
    """
    path = Path(folder) / "metrics.csv"
    rows = list(csv.DictReader(io.StringIO(_read_text(path, "the metrics of a run"))))
    for number, row in enumerate(rows, start=2):
        try:
            if None in row or None in row.values():
                raise ValueError
            int(row["step"]), float(row["value"]), row["phase"], row["name"]
        except (KeyError, ValueError):
            raise ValueError(
                f"{path} is damaged: line {number} has no {', '.join(COLUMNS)}. Restore the file, or leave the run out."
            ) from None
    return rows


def read_json(path: str | Path) -> dict[str, Any]:
    """A JSON file of a run.

    Raises:
        FileNotFoundError: when there is none.
        ValueError: for a file that is damaged.
    """
    try:
        content = json.loads(_read_text(Path(path), "a file of a run"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is damaged: it is no JSON ({error}). Restore the file, or run again.") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} is damaged: it holds no names with values. Restore the file, or run again.")
    return content


def read_yaml(path: str | Path) -> dict[str, Any]:
    """The settings in a YAML file.

    Raises:
        FileNotFoundError: when there is none.
        ValueError: for a file that is no YAML, or holds no settings.
    """
    try:
        content = OmegaConf.to_container(OmegaConf.create(_read_text(Path(path), "a file of settings")))
    except (yaml.YAMLError, OmegaConfBaseException) as error:
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())}. Mend the file.") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds no settings, but {type(content).__name__}. Write one KEY: VALUE a line.")
    return {str(key): value for key, value in content.items()}


def _read_text(path: Path, what: str) -> str:
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: {what}. Restore it, or run again.")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is damaged: it is no text in UTF-8 ({error}). Restore it, or save it as UTF-8."
        ) from None
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}. Allow it, or choose another.") from None
