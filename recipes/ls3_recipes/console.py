"""What a run says on the terminal."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ls3_torchrl.exceptions import DataWarning

console = Console()


@contextmanager
def command_line(who: str) -> Iterator[None]:
    """Inside, what is said reads well on a terminal.

    What is said of data comes as a line instead of a Python warning; TorchRL tells nothing but warnings; characters
    that the terminal lacks become question marks; and Ctrl-C and SIGTERM end with one line.

    Args:
        who: what lines begin with.

    Raises:
        SystemExit: with the shells' own code for Ctrl-C and SIGTERM, 130 and 143.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure") and (stream.encoding or "").lower().replace("-", "") != "utf8":
            stream.reconfigure(errors="replace")
    logger = logging.getLogger("torchrl")
    logger.addFilter(_is_warning)  # a level would be TorchRL's own again as soon as it is imported
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", DataWarning)
            warnings.showwarning = _show(who, warnings.showwarning)
            yield
    except KeyboardInterrupt as stop:
        print(f"{who}: {str(stop) or 'stopped by Ctrl-C'}.", file=sys.stderr)
        raise SystemExit(getattr(stop, "exit_code", 130)) from None
    finally:
        logger.removeFilter(_is_warning)


def _is_warning(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.WARNING


def _show(who: str, other: Any) -> Any:
    """What shows a warning: as a line where it is of data, as ever otherwise."""

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, DataWarning):
            print(f"{who}: {' '.join(str(message).split())}", file=sys.stderr)
        else:
            other(message, category, *where, **more)

    return show


def percent_of(figures: dict[str, Any]) -> tuple[str, str, str]:
    """Success, violation and return of a part of a summary, as the tables show them."""
    return (
        f"{figures['success_rate']:.0%}",
        f"{figures['violation_rate']:.0%}",
        f"{figures['return_mean']:.1f} ± {figures['return_std']:.1f}",
    )


def print_summary(summary: dict[str, Any], folder: Path) -> None:
    """The final table of a run or an evaluation."""
    table = Table(title="{algorithm} on {task}, preset {preset}, seed {seed}".format(**summary))
    for column in ("", "episodes", "success", "violation", "return"):
        table.add_column(column, justify="left" if not column else "right")
    for part in ("demonstrations", "online", "evaluation"):
        if part in summary:
            table.add_row(part, str(summary[part]["episodes"]), *percent_of(summary[part]))
    console.print(table)
    for name, value in summary.get("probe", {}).items():
        console.print(f"{name.replace('_', ' ')}: {value:.2f} units of the state")
    if "filter" in summary:
        console.print(
            "filter: another action in {intervention_rate:.0%} of the steps, {constraint_rate:.0%} for the constraint "
            "and {safe_set_rate:.0%} for the safe set; no safe one in {infeasible_rate:.0%}".format(**summary["filter"])
        )
    console.print(
        f"{summary['minutes']:.1f} minutes; everything is in [bold]{escape(str(folder))}[/bold]", soft_wrap=True
    )
