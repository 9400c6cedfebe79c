"""Checks of arguments, with messages that say what was received, what is allowed and what to do."""

from __future__ import annotations

import inspect
import operator
from collections.abc import Callable, Iterable
from difflib import get_close_matches
from functools import partial
from typing import Any


def whole_number(value: Any, name: str, least: int = 1, unit: str = "") -> int:
    """``value`` as an int, NumPy's whole numbers included.

    Raises:
        TypeError: for what is no whole number; a float is none, nor is a bool.
        ValueError: for one below ``least``.
    """
    try:
        if isinstance(value, bool):
            raise TypeError
        number = operator.index(value)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(
            f"{name} must be a whole number, at least {least}; got {value!r} of type {type(value).__name__}."
        ) from None
    if number < least:
        raise ValueError(f"{name} must be at least {least}{unit}, got {number}.")
    return number


def nearest(word: str, known: Iterable[str]) -> str:
    """``" Did you mean 'x'?"`` where one of the known words is close, else nothing."""
    close = get_close_matches(word, list(known), n=1)
    return f" Did you mean {close[0]!r}?" if close else ""


def parameters_of(call: Callable[..., Any]) -> dict[str, inspect.Parameter] | None:
    """What a class or function takes, by name; ``None`` for what does not say it, being written in C."""
    if isinstance(call, partial):
        inner = parameters_of(call.func)
        given = {} if inner is None else {name: call.keywords[name] for name in inner if name in call.keywords}
        return inner and inner | {name: inner[name].replace(default=value) for name, value in given.items()}
    try:
        # Of a class its own __init__: TorchRL's environments have a metaclass that takes anything and passes it on.
        found = inspect.signature(call.__init__ if isinstance(call, type) else call).parameters  # type: ignore[misc]
    except (TypeError, ValueError):
        return None
    return {name: parameter for name, parameter in found.items() if name != "self"}


def explain_options(error: TypeError, call: Callable[..., Any], options: Iterable[str]) -> None:
    """Raise Python's ``error`` about an option that ``call`` does not take anew, with those that it does."""
    known = list(parameters_of(call) or ())
    for option in options:
        if known and option not in known and f"unexpected keyword argument {option!r}" in str(error):
            raise TypeError(f"{error}. It has: {', '.join(known)}.{nearest(option, known)}") from None
