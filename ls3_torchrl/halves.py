"""Two computations at once, each on half of the cores."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Self, TypeVar

import torch

from ls3_torchrl._memory import keep_freed_memory

_T = TypeVar("_T")


class Halves:
    """Carries out two computations at a time, each on half of the cores; on a single core one after the other.

    Networks of this size keep one core busy and let two wait for each other after every layer. Each computation runs on
    one core where there are one or two: what comes of it is the same to the bit.

    It is a context, in which PyTorch computes on half of the cores, and at whose end no thread is left.

    Example:
        >>> with Halves() as both:
        ...     both(lambda: torch.ones(2).sum(), lambda: torch.ones(3).sum())
        (tensor(2.), tensor(3.))
    """

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._cores = 0

    def __enter__(self) -> Self:
        keep_freed_memory()
        self._cores = torch.get_num_threads()
        half = max(1, self._cores // 2)
        torch.set_num_threads(half)
        if self._cores > 1:
            self._pool = ThreadPoolExecutor(1, "halves", torch.set_num_threads, (half,))
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
        torch.set_num_threads(self._cores)

    def __call__(self, first: Callable[[], _T], second: Callable[[], _T]) -> tuple[_T, _T]:
        """What both return.

        Args:
            first: computed in the thread that calls.
            second: computed in the other, with grad mode, autocast and the like as a new thread has them.

        Raises:
            Exception: what either raises, once both have ended; that of the first where both do.
        """
        if self._pool is None:
            return first(), second()
        other = self._pool.submit(second)
        try:
            mine = first()
        finally:
            wait([other])
        return mine, other.result()
