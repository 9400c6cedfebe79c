"""``ls3 report``: several finished runs in one picture and one table."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from rich.markup import escape
from rich.table import Table

import ls3_envs  # noqa: F401  (before TorchRL, which imports MuJoCo: whatever MUJOCO_GL says)
from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.configuration import register, run_command
from ls3_recipes.console import console
from ls3_recipes.plots.report import check_alike, plot_report, read_run, rows_of
from ls3_recipes.plots.style import draw
from ls3_recipes.run_files import require_new
from ls3_recipes.run_settings import require_path

#: How algorithms are shown, in the order of legend and table.
LABELS = {name: label for algorithm in ALGORITHMS.values() for name, label in algorithm.labels.items()}

HELP = """
Compare finished runs: success, violations and return against online episodes, mean and standard error over seeds.

  ls3 report "runs=[DIR,DIR,...]" [output=DIR]

All runs must be of one task, with the same number of online episodes.

Examples
  ls3 report "runs=[runs/ls3-0,runs/ls3-1,runs/awac-0,runs/awac-1]" output=runs/report
"""


@dataclass(frozen=True, kw_only=True)
class ReportSettings:
    """What is compared, and where it goes.

    Args:
        runs: folders of finished runs, of any of the algorithms; one alone need not be a list.
        output: a folder that does not exist yet.
    """

    runs: tuple[str, ...] | str = ()
    output: str

    def __post_init__(self) -> None:
        """Take a single folder as a list of one."""
        if isinstance(self.runs, str):
            object.__setattr__(self, "runs", (self.runs,))
        for path in (*self.runs, self.output):
            require_path(path, "output" if path is self.output else "runs")


register("report", ReportSettings)


def report(settings: ReportSettings) -> list[dict[str, str]]:
    """Plot and tabulate.

    Returns:
        The table's rows.

    Raises:
        ValueError: without runs, or for runs that cannot be compared.
        FileNotFoundError: for a folder of no finished run.
        FileExistsError: when the output folder exists.
    """
    folder = require_new(settings.output)
    if not settings.runs:
        raise ValueError("No runs: pass runs=[DIR,DIR,...], folders of finished runs.")
    runs = [read_run(path) for path in settings.runs]
    check_alike(runs)
    rows = rows_of(runs, LABELS)
    folder.mkdir(parents=True)
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
    lines += ["| " + " | ".join(row.values()) + " |" for row in rows]
    (folder / "comparison.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    draw({"comparison.png": lambda: plot_report(runs, LABELS, folder / "comparison.png")})
    _print(rows, f"{runs[0].summary['task']}: mean ± standard error over seeds")
    console.print(f"Picture and table are in [bold]{escape(str(folder))}[/bold]")
    return rows


def _print(rows: Sequence[dict[str, str]], title: str) -> None:
    table = Table(title=title)
    shown = [column for column in rows[0] if not column.startswith("online")]
    for column in shown:
        table.add_column(column.replace(" ", "\n", 1), justify="left" if column == "algorithm" else "right")
    for row in rows:
        table.add_row(*(row[column] for column in shown))
    console.print(table)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    arguments = sys.argv[1:] if arguments is None else arguments
    run_command("report", ReportSettings, report, arguments, help_text=HELP)
