"""What a run computes on."""

from __future__ import annotations

import platform
from pathlib import Path

import torch

from ls3_envs.cores import available_cores
from ls3_recipes.run_settings import require_device_name


def choose_device(name: str) -> torch.device:
    """``auto`` takes CUDA where there is one; products of float32 matrices are TF32 there.

    Raises:
        ValueError: for a device that is not there, or none that is known here.
    """
    require_device_name(name)
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(
            f"device={name} was asked for, but PyTorch sees no CUDA device. Use device=cpu or device=auto."
        )
    if ":" in name and int(name.partition(":")[2]) >= torch.cuda.device_count():
        raise ValueError(
            f"device={name} was asked for, but PyTorch sees {torch.cuda.device_count()} CUDA devices, from cuda:0 on."
        )
    if name.startswith("cuda"):
        torch.set_float32_matmul_precision("high")
    return torch.device(name)


def processor() -> str:
    """The model of the processor."""
    if Path("/proc/cpuinfo").is_file():
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        models = [line for line in lines if line.startswith("model name")]
        if models:
            return models[0].split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def hardware(device: torch.device) -> dict[str, str | int]:
    """What the run ran on."""
    gpu = torch.cuda.get_device_name(device) if device.type == "cuda" else "none"
    return {"cpu": processor(), "cores": available_cores(), "threads": torch.get_num_threads(), "gpu": gpu}
