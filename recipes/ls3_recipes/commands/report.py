"""``ls3 report``: what several runs say together, on one page."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from ls3_recipes.arguments import split_arguments
from ls3_recipes.command_settings import ReportSettings
from ls3_recipes.configuration import register, run_command
from ls3_recipes.console import console
from ls3_recipes.extra import Job
from ls3_recipes.run_files import require_new

HELP = """
Report runs on one page that opens without a server: learning curves and tables with intervals over seeds, what a
setting changes, films of the best and worst episodes, maps through training, settings side by side, failures.

  ls3 report FOLDER [FOLDER ...] [output=DIR] [title=TEXT]

A folder is that of a run, or holds runs anywhere below it. Several tasks, algorithms and settings may be among them.

Examples
  ls3 report runs/figure1
  ls3 report runs/ls3-0 runs/ls3-1 runs/awac-0 output=runs/report
"""


register("report", ReportSettings)
write_report = Job("ls3 report", "ls3_recipes.report.writing:write_report")
figures_of = Job("ls3 report", "ls3_recipes.report.tables:figures_of")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    options, others = split_arguments(sys.argv[1:] if arguments is None else arguments)
    folders = [argument for argument in others if "=" not in argument or Path(argument).is_dir()]
    overrides = [argument for argument in others if argument not in folders]
    if folders:
        quoted = (folder.replace("\\", "\\\\").replace("'", "\\'") for folder in folders)
        overrides.append(f"""runs=[{",".join(f"'{folder}'" for folder in quoted)}]""")
    run_command("report", ReportSettings, report, [*overrides, *options], help_text=HELP)


def report(settings: ReportSettings) -> list[dict[str, str]]:
    """Write the page and its files, and print its tables.

    Returns:
        The tables' rows, those of each task after another.

    Raises:
        ValueError: for runs that cannot be compared.
        FileNotFoundError: for a folder without runs.
        FileExistsError: when the output folder exists.
    """
    folder, every = require_new(settings.output), []
    for part in write_report(settings.runs, folder, settings.title).parts:
        rows = figures_of(part.groups)
        every += rows
        table = Table(title=f"{part.task}, evaluation")
        shown = [name for name in rows[0] if not name.startswith("online")]
        for name in shown:
            heading = name.removeprefix("evaluation ").replace(" ", "\n", 1)
            table.add_column(heading, justify="left" if name == "algorithm" else "right")
        for row in rows:
            table.add_row(*(row[name] for name in shown))
        console.print(table)
    console.print(f"The page is [bold]{escape(str(folder / 'report.html'))}[/bold]", soft_wrap=True)
    return every
