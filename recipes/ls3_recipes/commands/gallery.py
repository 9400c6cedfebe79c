"""``ls3 gallery``: a picture of every domain."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from matplotlib.backend_bases import FigureCanvasBase

from ls3_envs.registry import DOMAINS
from ls3_recipes.console import command_line, console
from ls3_recipes.extra import Job
from ls3_recipes.run_files import require_writable

plot_gallery = Job("ls3 gallery", "ls3_recipes.plots.gallery:plot_gallery")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        "ls3 gallery", description="Draw domains: a demonstration and a violation of each."
    )
    parser.add_argument("file", type=Path, metavar="FILE.png", help="where the picture goes")
    parser.add_argument("--domains", nargs="+", default=list(DOMAINS), choices=list(DOMAINS))
    chosen = parser.parse_args(sys.argv[1:] if arguments is None else arguments)
    who = "ls3 gallery"
    with command_line(who):
        try:
            _require_picture(chosen.file)
        except (ValueError, OSError) as error:
            raise SystemExit(f"{who}: {error}") from None
        plot = plot_gallery.load()
        chosen.file.parent.mkdir(parents=True, exist_ok=True)
        console.print(f"The domains are in {plot(chosen.file, chosen.domains)}", markup=False)


def _require_picture(path: Path) -> None:
    """Refuse a file that no picture can be written to."""
    formats = sorted(FigureCanvasBase.get_supported_filetypes())
    if path.suffix.lower().lstrip(".") not in formats:
        raise ValueError(f"FILE must end in one of .{', .'.join(formats)}; got {str(path)!r}.")
    if path.is_dir() or (path.exists() and not os.access(path, os.W_OK)):
        raise ValueError(f"{path} cannot be written. Choose another file.")
    require_writable(path, "FILE")
