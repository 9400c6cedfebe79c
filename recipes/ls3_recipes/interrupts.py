"""Ctrl-C, SIGTERM and SIGHUP: leave when nothing is half done, and at once when asked again."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from ls3_recipes.console import console

#: The last comes when a terminal is closed or a connection ends; not on Windows.
_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
#: Heard even where a shell has started the process in the background, and ignores them.
_ALWAYS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """The run was asked to stop.

    Args:
        number: of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__("stopped by " + ("Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name))
        self.number = number

    @property
    def exit_code(self) -> int:
        """What a shell gives a process that this signal ended."""
        return 128 + self.number


class Interrupts:
    """Raises :class:`Interrupted` for a signal, but not while something is :meth:`deferred`.

    A second signal ends the process at once.

    Example:
        >>> try:
        ...     with Interrupts() as interrupts, interrupts.deferred():
        ...         signal.raise_signal(signal.SIGTERM)
        ...         print("This is not cut.")
        ... except Interrupted as stop:
        ...     print(stop, stop.exit_code)
        Stopping as soon as this step is saved; once more ends the run at once.
        This is not cut.
        stopped by SIGTERM 143
    """

    def __init__(self) -> None:
        self._number: int | None = None
        self._deferred = 0
        self._before: dict[int, Any] = {}

    @property
    def pending(self) -> bool:
        """Whether a signal waits for the end of what must not be cut."""
        return self._number is not None

    def __enter__(self) -> Interrupts:
        """Listen; in another thread than the main one Python cannot, and signals do what they did."""
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                if signal.getsignal(number) is signal.SIG_IGN and number not in _ALWAYS:
                    continue  # by nohup
                self._before[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        """Leave signals to who had them."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self._number is not None:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        self._number = number
        if not self._deferred:
            raise Interrupted(number)
        console.print("Stopping as soon as this step is saved; once more ends the run at once.")

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """What must not be cut anywhere: a signal waits for its end, or for a :meth:`check` where it can be cut."""
        self._deferred += 1
        try:
            yield
        finally:
            self._deferred -= 1
        if not self._deferred:
            self.check()

    def check(self) -> None:
        """Raise for a signal that waits."""
        if self._number is not None:
            raise Interrupted(self._number)
