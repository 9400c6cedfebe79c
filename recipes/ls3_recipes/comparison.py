"""Several finished runs in one picture and one table."""

from __future__ import annotations

from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.command_settings import ReportSettings
from ls3_recipes.console import console
from ls3_recipes.plots.report import check_alike, plot_report, read_run, rows_of
from ls3_recipes.plots.style import draw
from ls3_recipes.run_files import require_new

#: How algorithms are shown, in the order of legend and table.
LABELS = {name: label for row in ALGORITHMS.values() for name, label in row.load().labels.items()}


def report(settings: ReportSettings) -> list[dict[str, str]]:
    """Plot and tabulate.

    Returns:
        The table's rows.

    Raises:
        ValueError: for runs that cannot be compared.
        FileNotFoundError: for a folder of no finished run.
        FileExistsError: when the output folder exists.
    """
    folder = require_new(settings.output)
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
