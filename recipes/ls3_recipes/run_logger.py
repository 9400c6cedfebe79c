"""The logger of a run: metrics in a table and on TensorBoard."""

from __future__ import annotations

import csv
import os
import shutil
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from torchrl.record.loggers import Logger

from ls3_recipes.run_files import COLUMNS, read_metrics
from ls3_torchrl._checks import DataWarning
from ls3_torchrl.files import save_text_atomically


class RunLogger(Logger):
    """Writes scalars named ``phase/name`` to ``metrics.csv`` and to TensorBoard, behind what is there.

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

    experiment: SummaryWriter

    def __init__(self, folder: str | Path) -> None:
        self._start, self._earlier = time.perf_counter(), 0.0
        self._path = Path(folder) / "metrics.csv"
        self._count = max(self._path.read_bytes().count(b"\n") - 1, 0) if self._path.is_file() else 0
        self._open("a")
        if self._csv.tell() == 0:
            self._rows.writerow(COLUMNS)
        self._followers: list[Logger] = []
        super().__init__(exp_name="tensorboard", log_dir=str(folder))

    def follow(self, logger: Logger) -> None:
        """Have another logger get every metric as well, from now on."""
        self._followers.append(logger)

    def _open(self, mode: str) -> None:
        self._csv = self._path.open(mode, newline="", encoding="utf-8")
        self._rows = csv.writer(self._csv)

    def _create_experiment(self) -> SummaryWriter:
        return SummaryWriter(str(Path(self.log_dir) / self.exp_name))

    @property
    def seconds(self) -> float:
        """Seconds of the run so far, those before it was continued included."""
        return self._earlier + time.perf_counter() - self._start

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """One metric; what stands before the last slash of its name is its phase."""
        phase, _, metric = name.rpartition("/")
        try:
            self._rows.writerow([f"{self.seconds:.1f}", phase, step, metric, f"{value:.6g}"])
            self._csv.flush()
        except OSError as error:
            raise OSError(error.errno, f"{error.strerror}; a metric could not be written", str(self._path)) from error
        self._count += 1
        self.experiment.add_scalar(name, value, step)
        for follower in self._followers:
            follower.log_scalar(name, value, step)

    def log_video(self, name: str, video: Tensor, step: int | None = None, **options: Any) -> None:
        """A video ``[N, T, C, H, W]``, to TensorBoard."""
        self.experiment.add_video(name, video, global_step=step, **options)

    def log_hparams(self, cfg: Any) -> None:
        """Settings, to TensorBoard; the run's own are in ``config.yaml``."""
        self.experiment.add_text("settings", f"```yaml\n{OmegaConf.to_yaml(OmegaConf.create(cfg))}```")

    def log_histogram(self, name: str, data: Sequence, **options: Any) -> None:
        """A histogram, to TensorBoard."""
        self.experiment.add_histogram(name, data, options.get("step"))

    def state_dict(self) -> dict[str, Any]:
        """How much was logged; it is forced to the disk."""
        self._csv.flush()
        os.fsync(self._csv.fileno())
        return {"count": self._count, "seconds": self.seconds}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue behind what was logged then; what came after it is removed, from TensorBoard as well."""
        self._csv.close()
        lines = self._path.read_bytes().splitlines(keepends=True)
        if len(lines) <= state_dict["count"]:
            warnings.warn(
                f"{self._path} has {max(len(lines) - 1, 0)} rows, where {state_dict['count']} were written; the others "
                "are lost.",
                DataWarning,
                stacklevel=2,
            )
        save_text_atomically(b"".join(lines[: state_dict["count"] + 1]).decode(), self._path)
        self._open("a")
        self._count, self._earlier = state_dict["count"], state_dict["seconds"]
        self._start = time.perf_counter()
        self.experiment.close()
        shutil.rmtree(Path(self.log_dir) / self.exp_name, ignore_errors=True)
        board = self._create_experiment()
        with suppress(ValueError):  # a table that somebody has changed: the board lacks what follows
            for row in read_metrics(self.log_dir):
                board.add_scalar(f"{row['phase']}/{row['name']}", float(row["value"]), int(row["step"]))
        self.experiment = board

    def restart(self) -> None:
        """Remove all that was logged, half a line included."""
        self.load_state_dict({"count": 0, "seconds": 0.0})

    def close(self, timeout: float | None = None) -> None:
        """Write what is left, and close table and board."""
        with suppress(OSError):  # on a full disk: each row was flushed when it was written, or said to have failed
            self._csv.close()
            super().close(timeout)
            for follower in self._followers:
                follower.close(timeout)

    def __repr__(self) -> str:
        return f"RunLogger({self.log_dir!r})"
