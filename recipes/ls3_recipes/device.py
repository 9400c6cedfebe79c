"""What a run computes on."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import torch


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


def hardware(device: torch.device) -> dict[str, str | int]:
    """What the run ran on."""
    name = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").is_file():
        models = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
        name = models[0].split(":", 1)[1].strip() if models else name
    gpu = torch.cuda.get_device_name(device) if device.type == "cuda" else "none"
    return {"cpu": name, "cores": os.cpu_count() or 0, "threads": torch.get_num_threads(), "gpu": gpu}
