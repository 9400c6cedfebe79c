"""What the recipes share: the run folder, metrics, progress, and episodes' figures."""

from __future__ import annotations

import csv
import json
import os
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table
from tensordict import TensorDictBase
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

PACKAGES = ("torch", "torchrl", "tensordict", "numpy", "mujoco", "mujoco-warp", "hydra-core")
_INTERACTIVE = sys.stderr.isatty()
console = Console()


class RunFolder:
    """A run's folder: ``config.yaml``, ``versions.json``, ``metrics.csv``, ``tensorboard/``, ``checkpoints/``.

    Args:
        path: must not exist, so that no earlier run is ever overwritten.
        config: the resolved configuration, written at once.

    Raises:
        FileExistsError: when the folder exists.
    """

    def __init__(self, path: str | Path, config: DictConfig) -> None:
        self.path = Path(path)
        if self.path.exists():
            raise FileExistsError(
                f"The output folder {self.path} exists already, and a run never overwrites another. "
                "Choose another with output=DIR, or move the old one away."
            )
        self.path.mkdir(parents=True)
        (self.path / "config.yaml").write_text(OmegaConf.to_yaml(config, resolve=True))
        self.write_json(
            "versions.json",
            {name: version(name) for name in PACKAGES} | {"python": platform.python_version()},
        )
        self._csv = (self.path / "metrics.csv").open("w", newline="")
        self._rows = csv.writer(self._csv)
        self._rows.writerow(["seconds", "phase", "step", "name", "value"])
        self._tensorboard = SummaryWriter(str(self.path / "tensorboard"))
        self._start = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Seconds since the folder was made."""
        return time.perf_counter() - self._start

    def log(self, phase: str, step: int, **values: float) -> None:
        """Write metrics to CSV and TensorBoard."""
        for name, value in values.items():
            self._rows.writerow([f"{self.seconds:.1f}", phase, step, name, f"{value:.6g}"])
            self._tensorboard.add_scalar(f"{phase}/{name}", value, step)
        self._csv.flush()

    def write_json(self, name: str, content: dict) -> Path:
        """Write a JSON file in one go: a half-written file never takes its place."""
        path = self.path / name
        partial = path.with_suffix(".partial")
        partial.write_text(json.dumps(content, indent=2) + "\n")
        partial.replace(path)
        return path

    def close(self) -> None:
        """Flush and close what is open."""
        self._csv.close()
        self._tensorboard.close()


def read_metrics(folder: str | Path) -> list[dict[str, str]]:
    """The rows of a run's ``metrics.csv``."""
    with (Path(folder) / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def progress(total: int, what: str, unit: str = "step") -> tqdm:
    """A progress bar with the time left; a line now and then where there is no terminal."""
    return tqdm(
        total=total,
        desc=f"{what:<24}",
        unit=unit,
        mininterval=0.2 if _INTERACTIVE else 20.0,
        dynamic_ncols=_INTERACTIVE,
        leave=True,
        bar_format="{desc} {percentage:3.0f}%|{bar:24}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]",  # noqa: E501
    )


def tick(bar: tqdm) -> None:
    """Advance a bar from a forward hook, whose return value would replace the module's output."""
    bar.update()


@contextmanager
def timed(seconds: dict[str, float], phase: str) -> Iterator[None]:
    """Add the block's wall-clock seconds to ``seconds[phase]``."""
    start = time.perf_counter()
    yield
    seconds[phase] = seconds.get(phase, 0.0) + time.perf_counter() - start


def episode_figures(episodes: TensorDictBase) -> dict[str, torch.Tensor]:
    """Return, success and violation of each episode of ``[N, T]``; each ``[N]``."""
    return {
        "return": episodes["next", "reward"].sum((-1, -2)),
        "success": episodes["next", "success"].any(-2).squeeze(-1),
        "violation": episodes["next", "constraint"].any(-2).squeeze(-1),
    }


def summarise(figures: list[dict[str, torch.Tensor]]) -> dict[str, float | int]:
    """Rates and returns over all episodes, as ``summary.json`` has them."""
    merged = {name: torch.cat([part[name] for part in figures]).float() for name in figures[0]}
    returns = merged["return"]
    return {
        "success_rate": round(float(merged["success"].mean()), 4),
        "violation_rate": round(float(merged["violation"].mean()), 4),
        "return_mean": round(float(returns.mean()), 3),
        "return_std": round(float(returns.std(correction=0)), 3),
        "episodes": len(returns),
    }


def hardware(device: torch.device) -> dict[str, str | int]:
    """What the run ran on."""
    name = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").is_file():
        models = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
        name = models[0].split(":", 1)[1].strip() if models else name
    gpu = torch.cuda.get_device_name(device) if device.type == "cuda" else "none"
    return {"cpu": name, "cores": os.cpu_count() or 0, "threads": torch.get_num_threads(), "gpu": gpu}


def choose_device(name: str) -> torch.device:
    """``auto`` takes CUDA where there is one; products of float32 matrices are TF32 there.

    Raises:
        ValueError: when CUDA is asked for and there is none.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(
            f"device={name} was asked for, but PyTorch sees no CUDA device. Use device=cpu or device=auto."
        )
    if name.startswith("cuda"):
        torch.set_float32_matmul_precision("high")
    return torch.device(name)


def print_summary(summary: dict, folder: Path) -> None:
    """The final table on the terminal."""
    table = Table(title="{algorithm} on {task}, preset {preset}, seed {seed}".format(**summary))
    for column in ("", "episodes", "success", "violation", "return"):
        table.add_column(column, justify="left" if not column else "right")
    for part in ("demonstrations", "online", "evaluation"):
        if part in summary:
            s = summary[part]
            table.add_row(
                part,
                str(s["episodes"]),
                f"{s['success_rate']:.0%}",
                f"{s['violation_rate']:.0%}",
                f"{s['return_mean']:.1f} ± {s['return_std']:.1f}",
            )
    console.print(table)
    for name, value in summary.get("probe", {}).items():
        console.print(f"{name.replace('_', ' ')}: {value:.2f} units of the state")
    console.print(f"{summary['minutes']:.1f} minutes; everything is in [bold]{folder}[/bold]")
