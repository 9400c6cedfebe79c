"""What a run says on the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

console = Console()


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
    console.print(f"{summary['minutes']:.1f} minutes; everything is in [bold]{folder}[/bold]")
