"""The time that a plan may take."""

from __future__ import annotations

from time import perf_counter


class Deadline:
    """Says after every round of a search whether there is time for another.

    Time counts from its making. A round is taken to last as long as the longest one so far: a search that asks ends
    within its time, except for its first round, without which there is no plan.

    Args:
        max_ms: milliseconds; ``None`` for as long as it takes.

    Example:
        >>> Deadline(None).leaves_time()
        True
        >>> Deadline(0.0).leaves_time()
        False
    """

    def __init__(self, max_ms: float | None) -> None:
        self.max_ms = max_ms
        self._began = self._last = perf_counter()
        self._longest = 0.0

    def begin_round(self) -> None:
        """A round begins now."""
        self._last = perf_counter()

    def leaves_time(self, rounds: int = 1) -> bool:
        """Whether so many further rounds are expected to end in time; asked at the end of a round."""
        if self.max_ms is None:
            return True
        now = perf_counter()
        self._longest = max(self._longest, now - self._last)
        self._last = now
        return (now - self._began + rounds * self._longest) * 1e3 <= self.max_ms
