"""Agents that come with the package: to look at, or to filter with."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from ls3_recipes.arguments import name_in

FOLDER = Path(__file__).with_name("agents")
#: Episodes of a shipped agent unless others are asked for: those that the film shows, within seconds.
IN_FILM = 6


def shipped_agents() -> dict[str, Path]:
    """The folder of each, by the name of its task: ``agent.pt``, the settings of its run, and a card.

    Example:
        >>> sorted(shipped_agents())[0]
        'cable_routing'
    """
    return {path.parent.name: path.parent for path in sorted(FOLDER.glob("*/agent.pt"))}


def with_shipped_agents(command: str, arguments: Sequence[str]) -> list[str]:
    """Arguments in which an agent or filter that is called by its task's name is the folder of the one shipped.

    ``agent=TASK`` without a run stands for the shipped run, and its results go to a new folder below ``runs/``.

    Args:
        command: what the results' folder is named after.
        arguments: of the command line.

    Raises:
        ValueError: for an agent without a run that is not shipped.

    Example:
        >>> with_shipped_agents("evaluate", ["agent=checkpoints/agent_000.pt", "run=runs/mine"])
        ['agent=checkpoints/agent_000.pt', 'run=runs/mine']
    """
    shipped, given, out = shipped_agents(), {name_in(argument) for argument in arguments}, []
    for argument in arguments:
        name, _, value = argument.partition("=")
        if name == "filter" and value in shipped and not Path(value).exists():
            out.append(f"filter={quoted(shipped[value])}")
        elif name == "agent" and "run" not in given:
            if value not in shipped:
                raise ValueError(
                    f"agent={value} needs the folder of its run: give run=RUN_FOLDER. The agents that come with this "
                    f"package, and need none, are {', '.join(shipped)}."
                )
            out.append(f"run={quoted(shipped[value])}")
            if command == "evaluate" and "episodes" not in given:
                out.append(f"episodes={IN_FILM}")
            if "output" not in given:
                out.append(f"output=runs/{value}-{command}-{datetime.now():%Y%m%d-%H%M%S}")
        else:
            out.append(argument)
    return out


def quoted(path: Path) -> str:
    r"""A path as Hydra reads it back, whatever characters it has.

    Example:
        >>> print(quoted(Path("/it's/${here}")))
        '/it\'s/\${here}'
    """
    text = re.sub(r"(\\*)'", r"\1\1\'", str(path)).replace("${", r"\${")
    return f"'{text}'"
