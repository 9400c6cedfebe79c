"""How many cores this process may use, which is fewer than the machine has when it is pinned or in a container."""

from __future__ import annotations

import os
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")


def available_cores() -> int:
    """Cores that the scheduler lets this process use, and a container's quota allows; at least 1.

    ``os.cpu_count()`` is the machine's number: eight threads on two cores wait for each other.

    Example:
        >>> available_cores() >= 1
        True
    """
    pinned = hasattr(os, "sched_getaffinity")  # not on macOS and Windows
    cores = len(os.sched_getaffinity(0)) if pinned else os.cpu_count() or 1
    quota = _quota(_CGROUP)
    return max(1, cores if quota is None else min(cores, round(quota)))


def _quota(cgroup: Path) -> float | None:
    """A container's share of processor time in cores, by cgroups of version 2 or 1; ``None`` without a limit."""
    for names in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):
        try:
            limit, period = " ".join((cgroup / name).read_text() for name in names).split()
            if limit != "max" and int(limit) > 0:
                return int(limit) / int(period)
        except (OSError, ValueError, ZeroDivisionError):
            continue
    return None
