"""``ls3 gallery``: a picture of every domain."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import ls3_envs
from ls3_recipes.console import console
from ls3_recipes.plots.gallery import plot_gallery


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        "ls3 gallery", description="Draw domains: a demonstration and a violation of each."
    )
    parser.add_argument("file", type=Path, metavar="FILE.png", help="where the picture goes")
    parser.add_argument("--domains", nargs="+", default=list(ls3_envs.DOMAINS), choices=list(ls3_envs.DOMAINS))
    chosen = parser.parse_args(sys.argv[1:] if arguments is None else arguments)
    console.print(f"The domains are in [bold]{plot_gallery(chosen.file, chosen.domains)}[/bold]")
