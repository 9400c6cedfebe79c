"""Packages that the library itself can do without."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def require_package(name: str, who: str, package: str | None = None, *, extra: str = "data") -> Any:
    """A module of a package that the library itself can do without.

    Args:
        name: of the module, such as ``"PIL.Image"``.
        who: who asks, for messages.
        package: what to install where that is not called as the module; the module's first name when ``None``.
        extra: of ``ls3-torchrl``, that brings it along.

    Returns:
        The module.

    Raises:
        ModuleNotFoundError: when it cannot be imported, naming what to install.
    """
    try:
        return import_module(name)
    except ImportError as error:
        wanted = package or name.partition(".")[0]
        raise ModuleNotFoundError(
            f"{who} needs {wanted}, which cannot be imported ({error}). Install it: "
            f"pip install 'ls3-torchrl[{extra}]'.",
            name=error.name or wanted,
        ) from error
