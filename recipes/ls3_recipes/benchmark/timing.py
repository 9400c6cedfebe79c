"""A stopwatch that compares within one run."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch.utils.benchmark import Timer

from ls3_recipes.console import console


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
