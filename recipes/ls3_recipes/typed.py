"""Values of settings, checked and converted by the annotations of their fields."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

_WORDS = {bool: "true or false", int: "a whole number", float: "a finite number", str: "text", NoneType: "null"}
#: What PyTorch's and NumPy's integers hold.
_LARGEST = 2**63


def typed(value: Any, hint: Any, name: str) -> Any:
    """A value as its annotation says.

    Whole numbers may be written as floats (``1e3``), and floats as whole numbers; nothing else is converted.

    Args:
        value: as YAML or the command line gave it.
        hint: the annotation: ``bool``, ``int``, ``float``, ``str``, ``None``, ``Literal``, ``tuple`` of these, a union
            of these, or ``Any``.
        name: of the setting, with its section.

    Returns:
        The value; lists become tuples.

    Raises:
        TypeError: for a value of another type.
        ValueError: for one of the right type that no setting can have: NaN, infinity, another word than those allowed,
            a list of another length.

    Example:
        >>> typed(1e3, int, "vae.steps"), typed([1, 2], tuple[float, float] | None, "vae.warmup")
        (1000, (1.0, 2.0))
        >>> typed("fast", float, "vae.lr")
        Traceback (most recent call last):
        ...
        TypeError: vae.lr must be a finite number, got 'fast'.
    """
    if hint is Any:
        return _tuples(value)
    options = _options(hint)
    for option in options:
        if _fits(value, option):
            return _converted(value, option, hint, name)
    word = isinstance(value, str) and any(get_origin(option) is Literal for option in options)
    remedy = ""
    if str in options and isinstance(value, int | float) and not isinstance(value, bool):
        remedy = f" Put it in quotes: \"{name}='{value}'\"."
    elif isinstance(value, str) and value.lower().lstrip("+-.") in ("nan", "inf", "infinity"):
        word = True  # a number that is none, whatever the file's language calls it
    raise (ValueError if word else TypeError)(f"{name} must be {words(hint)}, got {value!r}.{remedy}")


def words(hint: Any) -> str:
    """An annotation in the words of an error.

    Example:
        >>> words(bool | Literal["auto"]), words(tuple[int, ...] | None)
        ("true or false, or 'auto'", 'a list of whole numbers, or null')
    """
    out = []
    for option in _options(hint):
        inner = get_args(option)
        if get_origin(option) is Literal:
            out.append(("one of " if len(inner) > 1 else "") + ", ".join(map(repr, inner)))
        elif get_origin(option) is tuple:
            count = "" if inner[-1] is Ellipsis else f"{len(inner)} "
            out.append(f"a list of {count}{_plural(inner[0])}")
        else:
            out.append(_WORDS.get(option, str(option)))
    return ", or ".join(out)


def _plural(hint: Any) -> str:
    return {int: "whole numbers", float: "finite numbers", str: "texts"}.get(hint, words(hint))


def _options(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _fits(value: Any, option: Any) -> bool:
    """Whether a value is of a type, a whole number written as a float included."""
    if get_origin(option) is Literal:
        return any(type(value) is type(choice) and value == choice for choice in get_args(option))
    if get_origin(option) is tuple:
        return isinstance(value, list | tuple)
    if option is int:
        return type(value) is int or (type(value) is float and value.is_integer())
    if option is float:
        return type(value) in (int, float)
    return type(value) is option


def _converted(value: Any, option: Any, hint: Any, name: str) -> Any:
    if get_origin(option) is tuple:
        return _list_of(value, option, hint, name)
    if option is int and abs(value) >= _LARGEST:
        raise ValueError(f"{name} must lie within 64 bits, got {value}.")
    if option is float:
        try:
            value = float(value)
        except OverflowError:
            value = math.inf
        if not math.isfinite(value):
            raise ValueError(f"{name} must be {words(hint)}, got {value}.")
    return option(value) if option in (int, float) else value


def _list_of(value: Any, option: Any, hint: Any, name: str) -> tuple[Any, ...]:
    inner = get_args(option)
    if inner[-1] is Ellipsis:
        inner = (inner[0],) * len(value)
    if len(inner) != len(value):
        raise ValueError(f"{name} must be {words(hint)}, got {list(value)}.")
    try:
        return tuple(typed(item, part, name) for item, part in zip(value, inner, strict=True))
    except (TypeError, ValueError) as error:
        raise type(error)(f"{name} must be {words(hint)}, got {list(value)}.") from None


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, tuple | list) else value


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """What to say after an unknown name: the nearest that there are, or nothing.

    Args:
        name: with its section.
        known: all names, with their sections.

    Example:
        >>> did_you_mean("planner.horizn", ["planner.horizon", "task.horizon", "seed"])
        ': did you mean planner.horizon?'
        >>> did_you_mean("horizon", ["planner.horizon", "task.horizon", "seed"])
        ': did you mean planner.horizon or task.horizon?'
        >>> did_you_mean("colour", ["planner.horizon"])
        ''
    """
    key = name.rpartition(".")[2]

    def likeness(one: str, other: str) -> float:
        return difflib.SequenceMatcher(None, one, other).ratio()

    last = {full: full.rpartition(".")[2] for full in known}
    found = [full for full in last if last[full] == key][:3]
    if not found:
        near = [full for full in last if likeness(last[full], key) > 0.7]
        found = sorted(near, key=lambda full: (-likeness(last[full], key), -likeness(full, name)))[:1]
    return f": did you mean {' or '.join(found)}?" if found else ""
