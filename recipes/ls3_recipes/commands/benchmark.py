"""``ls3 benchmark``: how long everything takes on this machine."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ls3_recipes.command_settings import BenchmarkSettings
from ls3_recipes.configuration import register, run_command
from ls3_recipes.extra import Job
from ls3_recipes.renamed import RENAMED_OF_BENCHMARK

HELP = """
Time planning, updates, the VAE, environments and buffer, cost as work grows, and whole runs; write benchmark.json,
benchmark.md, growth.png and runs.png.

  ls3 benchmark [figures=[NAME,...]] [presets=[cpu,paper]] [runs=[cpu]] [estimate=paper] [seconds=S] [reference=false]

Figures: planning, updates, vae, environments, buffer; candidates, particles, horizon, worlds, episodes and images are
cost as work grows; estimate is the time of a whole run from its steps, kernels what a GPU would be bound by, runs whole
runs by phase. All are measured unless figures says which; smoke=true measures everything at its smallest.

Every figure is a median with its interquartile range; ratios are taken within the run.
"""

register("benchmark", BenchmarkSettings)
run_benchmark = Job("ls3 benchmark", "ls3_recipes.benchmark.suite:run_benchmark")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    arguments = sys.argv[1:] if arguments is None else arguments
    renamed = RENAMED_OF_BENCHMARK
    run_command("benchmark", BenchmarkSettings, run_benchmark, arguments, help_text=HELP, renamed=renamed)
