"""A stopwatch that compares within one run, and its table."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from torch.utils.benchmark import Timer

from ls3_recipes.console import console

_TABLE_WIDTH = 116


class Bench:
    """Collects figures.

    Args:
        seconds: at least so long is measured for each figure.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.rows: list[dict[str, Any]] = []

    def time(
        self, what: str, call: Callable[[], object], *, per: int = 1, against: str | None = None, once: bool = False
    ) -> float:
        """Time ``call``.

        Args:
            what: the figure's name.
            call: what is timed.
            per: how many things one call does; the figure is of one.
            against: name of an earlier figure that this one is compared to.
            once: call it a single time, for what takes long.

        Returns:
            The median, in seconds, of one thing.
        """
        start = time.perf_counter()
        call()
        first = time.perf_counter() - start
        median, spread, runs = first / per, 0.0, 1
        if not once:
            timer = Timer("call()", globals={"call": call}, num_threads=torch.get_num_threads())
            found = timer.blocked_autorange(min_run_time=max(self.seconds, 4 * first))  # a spread needs several runs
            median, spread, runs = found.median / per, found.iqr / per, len(found.times)
        earlier = {row["what"]: row["median_ms"] for row in self.rows}
        row: dict[str, Any] = {
            "what": what,
            "median_ms": 1e3 * median,
            "iqr_ms": 1e3 * spread,
            "runs": runs,
        }
        if against is not None and against in earlier:
            row |= {"against": against, "times_faster": earlier[against] / row["median_ms"]}
        self.rows.append(row)
        faster = f"  {row['times_faster']:.1f} times faster than {against}" if "times_faster" in row else ""
        console.print(f"{what:<46}{row['median_ms']:10.3f} ms{faster}")
        return median


def matmul_peak(bench: Bench, dtype: torch.dtype, device: torch.device, size: int = 2048) -> float:
    """The most FLOP/s that a square product reaches here."""
    a, b = (torch.randn(size, size, device=device).to(dtype) for _ in range(2))
    name = str(dtype).removeprefix("torch.")
    return 2 * size**3 / bench.time(f"product of {size} x {size}, {name}", lambda: a @ b)


def show(rows: list[dict[str, Any]], folder: Path) -> None:
    """The final table, on the terminal and as ``benchmark.md``."""
    columns = ("", "median", "spread", "runs", "faster", "of peak", "per CPU-s")
    lines = []
    for row in rows:
        digits = max(0, 2 - math.floor(math.log10(max(row["median_ms"], 1e-9))))
        lines.append(
            (
                row["what"],
                f"{row['median_ms']:.{digits}f} ms",
                f"{row['iqr_ms']:.{digits}f}",
                str(row["runs"]),
                f"{row['times_faster']:.1f}" if "times_faster" in row else "",
                f"{row['share_of_peak']:.0%}" if "share_of_peak" in row else "",
                f"{row['per_cpu_second']:.0f}" if "per_cpu_second" in row else "",
            )
        )
    caption = "faster: how many times, than the reference; of peak: of the largest product's FLOP/s"
    table = Table(title="Benchmark", caption=caption)
    for column in columns:
        table.add_column(column, justify="left" if not column else "right", no_wrap=True)
    for line in lines:
        table.add_row(*line)
    # A log file has no width; what is cut there cannot be read anywhere.
    wide = console if console.width >= _TABLE_WIDTH else Console(width=_TABLE_WIDTH)
    wide.print(table)
    rule = "|---|" + "---:|" * (len(columns) - 1)
    text = [f"| {' | '.join(line)} |" for line in (columns, *lines)]
    (folder / "benchmark.md").write_text("\n".join([text[0], rule, *text[1:], "", caption, ""]), encoding="utf-8")
    console.print(f"benchmark.json and benchmark.md are in [bold]{escape(str(folder))}[/bold]")
