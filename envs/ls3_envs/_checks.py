"""Checks of arguments, with messages that say what was received, what is allowed and what to do."""

from __future__ import annotations

import inspect
import operator
from collections.abc import Callable, Iterable
from difflib import get_close_matches
from typing import Any

import torch


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


def usable_device(device: torch.device | str) -> torch.device:
    """The device, after a look at whether this machine has it.

    Raises:
        ValueError: for a name that PyTorch does not know, or a device that is not there.
    """
    try:
        found = torch.device(device)
        torch.empty(0, device=found)
    except (TypeError, RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        raise ValueError(
            f"device {device!r} cannot be used here: {reason}. Use device='cpu', or one there is."
        ) from None
    return found


def nearest(word: str, known: Iterable[str]) -> str:
    """``" Did you mean 'x'?"`` where one of the known words is close, else nothing."""
    close = get_close_matches(word, list(known), n=1)
    return f" Did you mean {close[0]!r}?" if close else ""


def check_options(call: Callable[..., Any], options: Iterable[str]) -> None:
    """Raise ``TypeError`` for options that ``call`` does not take, naming those that it does."""
    try:
        parameters = inspect.signature(call).parameters.values()
    except (TypeError, ValueError):
        return  # what is written in C says nothing of itself; it answers when it is called
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return
    known = [parameter.name for parameter in parameters if parameter.kind is not parameter.POSITIONAL_ONLY]
    for option in options:
        if option not in known:
            raise TypeError(
                f"{getattr(call, '__name__', call)!s} has no option {option!r}; it has: {', '.join(known)}."
                f"{nearest(option, known)}"
            )
