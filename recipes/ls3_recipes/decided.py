"""What settings leave open, decided once for a run by a measurement or the machine."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch

from ls3_recipes.run_settings import RunSettings
from ls3_torchrl.layers import fastest_precision

S = TypeVar("S", bound=RunSettings)


def decided(settings: S, device: torch.device, begun: Mapping[str, Any]) -> S:
    """Settings in which nothing is left open: what a measurement or the machine decides is decided once for a run.

    Args:
        settings: of a run.
        device: that it computes on.
        begun: the settings with which it began, if it is continued.
    """
    changes: dict[str, Any] = {"device": str(device)}
    if settings.threads is None:
        changes["threads"] = begun.get("threads") or torch.get_num_threads()
    for name in ("data", "scratch_dir"):
        if (path := getattr(settings, name)) is not None:
            changes[name] = str(Path(path).absolute())  # it goes on from other folders as well
    choices = {"vae": "autocast", "optim": "autocast", "planner": "precision"}
    for name, choice in choices.items():
        section = getattr(settings, name, None)
        if getattr(section, choice, None) == "auto":
            value = begun[name][choice] if begun else _fastest(choice, device)
            changes[name] = dataclasses.replace(section, **{choice: value})  # type: ignore[type-var]
    return dataclasses.replace(settings, **changes)


def _fastest(choice: str, device: torch.device) -> str | bool:
    precision = fastest_precision(device.type)
    return precision if choice == "precision" else precision == "bf16"
