"""Arguments of the command line: which are Hydra's own options, and which are settings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

#: Hydra's options that take the next argument as their value.
WITH_VALUE = (
    *("--cfg", "-c", "--package", "-p", "--experimental-rerun"),
    *("--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd"),
)


def name_in(override: str) -> str:
    """The setting that an argument of the command line sets."""
    return override.partition("=")[0].lstrip("+~")


def split_arguments(arguments: Iterable[str]) -> tuple[list[str], list[str]]:
    """Hydra's own options with their values, and the settings.

    Example:
        >>> split_arguments(["seed=1", "--config-dir", "mine", "preset=own", "--help"])
        (['--config-dir', 'mine', '--help'], ['seed=1', 'preset=own'])
    """
    options: list[str] = []
    overrides: list[str] = []
    for argument in arguments:
        last = options[-1] if options else ""
        value = last in WITH_VALUE or (last in ("--info", "-i") and "=" not in argument)
        (options if value or argument.startswith("-") else overrides).append(argument)
    return options, overrides


def config_dir(options: Sequence[str]) -> str | None:
    """The folder of a user's own files."""
    for option, value in zip(options, [*options, ""][1:], strict=True):
        name, equals, same = option.partition("=")
        if name in ("--config-dir", "-cd"):
            return same if equals else value
    return None
