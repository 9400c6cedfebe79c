"""The command ``ls3``: one file for each of its commands, imported when it is chosen."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

from ls3_recipes.extra import remedy_named

#: What there is, and what it does.
COMMANDS = {
    "train": "train an agent: demonstrations, offline training, online improvement, evaluation, pictures",
    "collect": "collect a task's offline episodes, to train on later",
    "evaluate": "let a trained agent act, without learning",
    "calibrate": "find thresholds that miss few violations, and count what they miss",
    "sweep": "carry out many runs: a figure of the paper, or settings of your own",
    "report": "show what several runs say together, on one page",
    "benchmark": "time planning, updates, environments and buffer on this machine",
    "gallery": "draw every domain: a demonstration and a violation",
}


def overview() -> str:
    """What ``ls3 --help`` prints."""
    lines = [f"  {name:<10} {what}" for name, what in COMMANDS.items()]
    return "\n".join(
        [
            "LS3 (Latent Space Safe Sets): learn a task from images, safely.",
            "",
            "  ls3 COMMAND [KEY=VALUE ...]",
            "",
            "Commands",
            *lines,
            "",
            "ls3 COMMAND --help tells what can be set.",
        ]
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that the arguments name.

    Args:
        arguments: the name of a command and what it is to do; those of the command line when ``None``.

    Returns:
        0, or 2 for an unknown command.

    Raises:
        SystemExit: with one line, where a package is missing; by the command, for what it refuses.
    """
    name, *rest = [*(sys.argv[1:] if arguments is None else arguments)] or ["--help"]
    if name in ("-h", "--help"):
        print(overview())
        return 0
    if name not in COMMANDS:
        print(f"ls3 has no command {name!r}. It has: {', '.join(COMMANDS)}.", file=sys.stderr)
        return 2
    with remedy_named(f"ls3 {name}"):
        command = import_module(f"ls3_recipes.commands.{name}")
    command.main(rest)
    return 0
