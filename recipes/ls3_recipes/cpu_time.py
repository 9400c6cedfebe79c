"""CPU time of this process and of all that it has started, those included that are still at work."""

from __future__ import annotations

import math
import os
import time
from collections import defaultdict
from contextlib import suppress
from pathlib import Path

_PROC = Path("/proc")
#: In what follows the name in ``/proc/PID/stat``: the parent, and clock ticks of the process and its ended children.
_PARENT, _TICKS = 1, slice(11, 15)


def cpu_seconds() -> float:
    """Seconds of all cores together that this process and its descendants have computed; NaN where none can tell.

    A system tells of children when they have ended and were waited for. Trainers and workers that were forked live for
    long, and what they have computed until now stands in Linux's ``/proc`` alone.

    Example:
        >>> before = cpu_seconds()
        >>> math.isnan(before) or cpu_seconds() >= before
        True
    """
    if not (_PROC / "self" / "stat").is_file():
        return math.nan
    ended = os.times()
    return time.process_time() + ended.children_user + ended.children_system + _of_descendants()


def _of_descendants() -> float:
    """CPU seconds of the living descendants, and of those of theirs that they have waited for."""
    children: dict[int, list[int]] = defaultdict(list)
    ticks: dict[int, int] = {}
    for path in _PROC.glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):  # it has just ended
            # The name comes in parentheses, and may hold spaces and parentheses itself.
            fields = path.read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
            process = int(path.parent.name)
            ticks[process] = sum(map(int, fields[_TICKS]))
            children[int(fields[_PARENT])].append(process)
    total, left = 0, list(children[os.getpid()])
    while left:
        process = left.pop()
        total += ticks[process]
        left += children[process]
    return total / os.sysconf("SC_CLK_TCK")
