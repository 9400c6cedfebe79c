"""When the state of a run is saved: when something is done, by the clock, and when a signal asks to stop."""

from __future__ import annotations

import time
from collections.abc import Mapping

from ls3_recipes.interrupts import Interrupts
from ls3_torchrl.trainers import Checkpoints, Stateful


class RunState:
    """The parts of a run that continues: saved when something is done, and by the clock while something goes on.

    Args:
        checkpoints: where to.
        parts: all that decides what the run will do.
        interrupts: what asks it to stop.
        minutes: between the saves of :meth:`after_step`.
    """

    def __init__(
        self, checkpoints: Checkpoints, parts: Mapping[str, Stateful], interrupts: Interrupts, minutes: float
    ) -> None:
        self._checkpoints, self._parts, self._interrupts = checkpoints, parts, interrupts
        self._seconds = 60.0 * minutes
        self._saved = time.monotonic()

    def save(self) -> None:
        """Save now; a signal that comes meanwhile waits."""
        with self._interrupts.deferred():
            self._checkpoints.save(self._parts)
        self._saved = time.monotonic()

    def after_step(self) -> None:
        """Save when it is time, and leave when a signal waits."""
        if self._interrupts.pending or time.monotonic() - self._saved > self._seconds:
            self._checkpoints.save(self._parts)
            self._saved = time.monotonic()
            self._interrupts.check()

    def load(self) -> bool:
        """Take up the newest state that is whole; ``False`` when there is none."""
        return self._checkpoints.load(self._parts)
