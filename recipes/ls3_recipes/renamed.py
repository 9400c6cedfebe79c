"""Former settings: by other names, still read with a warning that gives the present one, and such as are gone."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

#: Former name of a setting: its present one.
RENAMED = {
    "vae.agent": "vae.checkpoint",
    "loss.gamma": "buffer.gamma",
    "loss.success_tail": "buffer.success_tail",
    "loss.undecided_weight": "loss.timed_out_weight",
    "online.share": "online.fraction",
    "task.buffer_capacity": "buffer.capacity",
    "task.sacfd_penalty": "policy.penalty",
    "task.risk.gamma": "policy.risk.gamma",
    "task.risk.threshold": "policy.risk.threshold",
}

#: Settings that are gone, and the value that is the only one now.
REMOVED: dict[str, Any] = {
    "vae.crop_scale": None,
    "offline.value_td_steps": 0,
    "vae.reduction": "mean",
    "optim.bootstrap": True,
    "agent.propagation": "ts1",
    "planner.common_noise": True,
    "planner.min_std": 0.0,
    "planner.constraint_reduction": "max",
    "buffer.dynamics_after_violation": False,
    "loss.frozen_dynamics": False,
    "online.select": "best",
    "vae.unit_scale": True,
    "planner.goal_reduction": "count",
    "agent.initial_value": 0.0,
    "loss.failure_weight": 0.0,
    "loss.failure_rows": "all",
    "loss.failure_value": None,
    "optim.cooldown": 0.0,
    "loss.monte_carlo": False,
    "loss.continue_failures": False,
    "buffer.continue_failures": False,
    "planner.pessimism": 0.0,
    "policy.learn_alpha": False,
    "policy.zero_at_goal": False,
}

#: Of the benchmark, whose settings have no sections.
RENAMED_OF_BENCHMARK = {"plain": "reference"}


#: The command that runs, as its messages name it; ``None`` in programs.
_COMMAND: ContextVar[str | None] = ContextVar("command", default=None)


@contextmanager
def on_command_line(command: str) -> Iterator[None]:
    """Inside, a former name is told in one line on the standard error instead of a Python warning.

    Args:
        command: what the line begins with.
    """
    token = _COMMAND.set(command)
    try:
        yield
    finally:
        _COMMAND.reset(token)


def _warn(old: str, new: str) -> None:
    if command := _COMMAND.get():
        print(f"{command}: {old} is now {new}", file=sys.stderr)
        return
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


def rename_settings(
    settings: Mapping[str, Any], renamed: Mapping[str, str] = RENAMED, *, explicit: Collection[str] | None = None
) -> dict[str, Any]:
    """Nested settings of a file with present names; where both are there, the present one counts.

    Args:
        settings: of a file, or composed of several.
        renamed: present names by former ones.
        explicit: for composed settings, the present names that arguments set. All others are there by default, and
            give way to the former ones that a user's file has.

    Raises:
        ValueError: for a setting that is gone, where its value would change what is done.
    """
    out: dict[str, Any] = _copy(settings)
    for old, new in renamed.items():
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
        # The task's former penalty was SACfD's: AWAC has always had its own.
        foreign = old == "task.sacfd_penalty" and out.get("algorithm") == "awac"
        if name not in target or not (explicit is None or new in explicit or foreign):
            target[name] = value
    _drop_removed(out, trained=explicit is None)
    return out


def _drop_removed(settings: dict[str, Any], *, trained: bool) -> None:
    """Leave out what is gone; where an agent was trained with it, say so, otherwise refuse."""
    gone = {}
    for old, only in REMOVED.items():
        section, name = old.split(".")
        values = settings.get(section)
        if not isinstance(values, dict) or name not in values:
            continue
        value = values.pop(name)
        if old == "vae.unit_scale":
            only = bool(values.get("prediction_weight"))
        if value != only and not trained:
            raise ValueError(f"{removed(old)} Got {value!r}.")
        if value != only:
            gone[old] = value
    if gone:
        _tell_of_gone(gone)


def _tell_of_gone(gone: Mapping[str, Any]) -> None:
    """Say in one line with what a run was trained that is gone, and what of it matters to its agent now."""
    said = ", ".join(f"{name}={json.dumps(value)}" for name, value in gone.items())
    planned = [name for name in gone if name.startswith("planner.") or name == "agent.propagation"]
    acts = "" if not planned else f" Its agent plans now without {', '.join(planned)}."
    message = f"this run was trained with settings that are gone: {said}.{acts}"
    if command := _COMMAND.get():
        print(f"{command}: {message}", file=sys.stderr)
        return
    warnings.warn(message[0].upper() + message[1:], stacklevel=5)


def removed(name: str) -> str:
    """What is said about a setting that is gone.

    Example:
        >>> removed("vae.crop_scale")
        'The setting vae.crop_scale is gone: all runs do now what it did at null. Leave it out.'
    """
    if name == "vae.unit_scale":
        return f"The setting {name} is gone: it follows vae.prediction_weight. Leave it out."
    only = json.dumps(REMOVED[name]).strip('"')
    return f"The setting {name} is gone: all runs do now what it did at {only}. Leave it out."


def _drop_empty(settings: dict[str, Any], path: Sequence[str]) -> None:
    if len(path) > 1 and not settings[path[0]][path[1]]:
        del settings[path[0]][path[1]]


def _copy(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {str(key): _copy(value) if isinstance(value, Mapping) else value for key, value in settings.items()}
