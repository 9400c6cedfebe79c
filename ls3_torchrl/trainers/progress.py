"""Progress bars that tell the time left, and can be switched off."""

from __future__ import annotations

import sys
from typing import Protocol

from tqdm import tqdm

_FORMAT = "{desc} {percentage:3.0f}%|{bar:24}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"


class Bar(Protocol):
    """What shows how far something has come, such as a bar of tqdm."""

    def update(self, n: int = 1) -> object:
        """``n`` more steps were taken."""

    def set_postfix_str(self, s: str, refresh: bool = True) -> object:
        """Say something behind the bar."""


def progress_bar(total: int, description: str, *, unit: str = "step", done: int = 0, enabled: bool = True) -> tqdm:
    """A progress bar with the time left; a line now and then where there is no terminal.

    Args:
        total: steps in all.
        description: what is going on.
        unit: of the steps.
        done: how many of them were taken earlier.
        enabled: whether anything is shown.
    """
    interactive = sys.stderr.isatty()
    return tqdm(
        total=total,
        initial=done,
        desc=f"{description:<24}",
        unit=unit,
        mininterval=0.2 if interactive else 20.0,
        dynamic_ncols=interactive,
        leave=True,
        bar_format=_FORMAT,
        disable=not enabled,
    )
