"""Settings by their former names: still read, with a warning that gives the present one."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

#: Former name of a setting: its present one.
RENAMED = {
    "vae.agent": "vae.checkpoint",
    "loss.gamma": "buffer.gamma",
    "loss.success_tail": "buffer.success_tail",
    "loss.continue_failures": "buffer.continue_failures",
    "loss.frozen_dynamics": "buffer.dynamics_after_violation",
    "loss.undecided_weight": "loss.timed_out_weight",
    "online.share": "online.fraction",
    "task.buffer_capacity": "buffer.capacity",
    "task.sacfd_penalty": "policy.penalty",
    "task.risk.gamma": "policy.risk.gamma",
    "task.risk.threshold": "policy.risk.threshold",
}

#: Of the benchmark, whose settings have no sections.
RENAMED_OF_BENCHMARK = {"plain": "reference"}


def _warn(old: str, new: str) -> None:
    warnings.warn(f"The setting {old} is now called {new}; the former name will not be read for ever.", stacklevel=3)


def rename_overrides(overrides: Iterable[str], renamed: Mapping[str, str] = RENAMED) -> list[str]:
    """Arguments of the command line with present names.

    Example:
        >>> rename_overrides(["loss.gamma_safe_set=0.5", "seed=3"])
        ['loss.gamma_safe_set=0.5', 'seed=3']
    """
    out = []
    for override in overrides:
        key, equals, value = override.partition("=")
        name = key.lstrip("+~")
        if equals and name in renamed:
            _warn(name, renamed[name])
            override = f"{key[: len(key) - len(name)]}{renamed[name]}={value}"
        out.append(override)
    return out


def rename_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Nested settings of a file with present names; where both are there, the present one counts."""
    out: dict[str, Any] = _copy(settings)
    for old, new in RENAMED.items():
        *path, name = old.split(".")
        section: Any = out
        for key in path:
            section = section.get(key) if isinstance(section, dict) else None
        if not isinstance(section, dict) or name not in section:
            continue
        _warn(old, new)
        value = section.pop(name)
        _drop_empty(out, path)
        *path, name = new.split(".")
        target = out
        for key in path:
            target = target.setdefault(key, {})
        target.setdefault(name, value)
    return out


def _drop_empty(settings: dict[str, Any], path: Sequence[str]) -> None:
    if len(path) > 1 and not settings[path[0]][path[1]]:
        del settings[path[0]][path[1]]


def _copy(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {str(key): _copy(value) if isinstance(value, Mapping) else value for key, value in settings.items()}
