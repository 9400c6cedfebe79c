"""Which settings are an algorithm's own: what files bring for others is left out, arguments refused."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.arguments import name_in
from ls3_recipes.options import defaults
from ls3_recipes.run_settings import RunSettings


@cache
def _known_anywhere() -> dict[str, Any]:
    """The settings of all algorithms together: what a preset or a task may hold."""
    known: dict[str, Any] = {}
    for algorithm in ALGORITHMS.values():
        known = _union(known, defaults(algorithm.settings_class))
    return known


def _union(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(one)
    for key, value in other.items():
        both = isinstance(value, Mapping) and isinstance(out.get(key), Mapping)
        out[key] = _union(out[key], value) if both else value
    return out


def prune(values: Mapping[str, Any], settings: type) -> dict[str, Any]:
    """Leave out what only other algorithms have: a preset and a task bring the settings of all of them.

    What nobody has is refused: here, or when the settings are built.

    Raises:
        ValueError: for a setting that nobody has, in a section that only others have.
    """
    return _prune(values, defaults(settings), _known_anywhere())


def _prune(
    values: Mapping[str, Any], own: Mapping[str, Any], known: Mapping[str, Any], where: str = ""
) -> dict[str, Any]:
    out = {}
    for key, value in values.items():
        if key not in own and key in known:
            _refuse_unknown(value, known[key], where + key)
            continue
        nested = isinstance(value, Mapping) and isinstance(own.get(key), Mapping)
        out[key] = _prune(value, own[key], known.get(key, {}), f"{where}{key}.") if nested else value
    return out


def _refuse_unknown(value: Any, known: Any, where: str) -> None:
    """Refuse what nobody has, in a section that is left out."""
    if isinstance(value, Mapping) and isinstance(known, Mapping):
        for key, inner in value.items():
            if key not in known:
                raise ValueError(f"{where} has no setting {key}. It has: {', '.join(known)}.")
            _refuse_unknown(inner, known[key], f"{where}.{key}")


def refuse_irrelevant(overrides: Iterable[str], settings: type, who: str) -> None:
    """Refuse arguments of the command line that set what only other algorithms have.

    Raises:
        ValueError: naming the setting, and what there is instead.
    """
    known = _known_anywhere()
    for override in overrides:
        own: Any = defaults(settings)
        elsewhere: Any = known
        path = name_in(override).split(".")
        for depth, key in enumerate(path):
            if not isinstance(own, Mapping) or "@" in key:
                break
            if key not in own and isinstance(elsewhere, Mapping) and key in elsewhere:
                missing, section = ".".join(path[: depth + 1]), ".".join(path[:depth])
                its = f"Its {section} has" if section else "It has"
                raise ValueError(f"{override}: {who} has no {missing}. {its}: {', '.join(own)}.")
            own = own.get(key)
            elsewhere = elsewhere.get(key) if isinstance(elsewhere, Mapping) else None


def refuse_unread(overrides: Iterable[str], settings: Any) -> None:
    """Refuse arguments of the command line that set what nothing reads, with the other settings as they are.

    Raises:
        ValueError: naming the setting that would make them matter.
    """
    unread = settings.unread if isinstance(settings, RunSettings) else {}
    for override in overrides:
        name = name_in(override)
        for section, remedy in unread.items():
            if f"{name}.".startswith(f"{section}."):
                raise ValueError(f"{override}: {section} only matters with {remedy}. Add that, or leave {name} out.")
