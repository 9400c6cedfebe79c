"""The benchmark's tables, on the terminal and as ``benchmark.md``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ls3_recipes.console import console

_WIDTH = 116


class Section(NamedTuple):
    """A table: its title, its columns, its lines, and what must be known to read it."""

    title: str
    columns: Sequence[str]
    lines: Sequence[Sequence[str]]
    caption: str


def milliseconds(value: float) -> tuple[str, int]:
    """A time with three digits, and how many of them stand behind the point."""
    digits = max(0, 2 - math.floor(math.log10(max(value, 1e-9))))
    return f"{value:.{digits}f}", digits


def figures_section(rows: Sequence[dict[str, Any]]) -> Section:
    """The table of everything that was timed."""
    lines = []
    for row in rows:
        median, digits = milliseconds(row["median_ms"])
        lines.append(
            (
                row["what"],
                f"{median} ms",
                f"{row['iqr_ms']:.{digits}f}",
                str(row["runs"]),
                f"{row['times_faster']:.1f}" if "times_faster" in row else "",
                f"{row['share_of_peak']:.0%}" if "share_of_peak" in row else "",
                f"{row['per_cpu_second']:.0f}" if "per_cpu_second" in row else "",
            )
        )
    columns = ("", "median", "spread", "runs", "faster", "of peak", "per CPU-s")
    caption = "faster: how many times, than the reference; of peak: of the largest product's FLOP/s"
    return Section("Benchmark", columns, lines, caption)


def show(sections: Sequence[Section], folder: Path) -> None:
    """All tables, on the terminal and as ``benchmark.md``."""
    # A log file has no width; what is cut there cannot be read anywhere.
    wide = console if console.width >= _WIDTH else Console(width=_WIDTH)
    text: list[str] = []
    for section in sections:
        table = Table(title=section.title, caption=section.caption)
        for i, column in enumerate(section.columns):
            table.add_column(column, justify="right" if i else "left", no_wrap=True)
        for line in section.lines:
            table.add_row(*map(escape, line))
        wide.print(table)
        head, *body = (f"| {' | '.join(line)} |" for line in (section.columns, *section.lines))
        rule = "|---|" + "---:|" * (len(section.columns) - 1)
        text += [f"## {section.title}", "", head, rule, *body, "", section.caption, ""]
    (folder / "benchmark.md").write_text("\n".join(text), encoding="utf-8")
    console.print(f"Tables, pictures and benchmark.json are in [bold]{escape(str(folder))}[/bold]", soft_wrap=True)
