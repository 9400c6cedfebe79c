"""What the allocator does with memory that is freed."""

from __future__ import annotations

from functools import lru_cache

import torch


@lru_cache(maxsize=1)
def keep_freed_memory() -> None:
    """Have the allocator keep freed memory for the next layers: once a process, and free of charge.

    glibc gives freed blocks back to the system, to fetch them again page by page, unless it has seen a larger block
    come and go; then it keeps up to twice that much. Without it a plan at paper sizes may spend a third of its time on
    pages, a small step of the VAE a sixth. Up to 32 MiB count; other allocators are not moved by it. None of these
    pages is ever touched.
    """
    torch.empty(31 << 20, dtype=torch.uint8)
