"""How far a run got: what is saved of it beside the algorithm's networks and the episodes."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from torchrl.checkpoint import GlobalRNGState
from torchrl.envs import TransformedEnv

from ls3_envs.cores import available_cores
from ls3_recipes.cpu_time import cpu_seconds


class Progress:
    """Phases and updates that are done, and the time that each kind of work has taken.

    Example:
        >>> progress = Progress()
        >>> with progress.timed("vae"):
        ...     progress.phases.append("vae")
        >>> other = Progress()
        >>> other.load_state_dict(progress.state_dict())
        >>> other.phases, sorted(other.seconds)
        (['vae'], ['vae'])
    """

    def __init__(self) -> None:
        #: Offline phases that are done.
        self.phases: list[str] = []
        #: Rounds of online episodes that are on the disk and in the buffer.
        self.collected = 0
        #: Updates that are done.
        self.updated = 0
        self._seconds: dict[str, float] = {}
        self._cpu_seconds: dict[str, float] = {}
        self._running: dict[str, tuple[float, float]] = {}

    @property
    def seconds(self) -> dict[str, float]:
        """Wall-clock seconds by kind of work, those of what is going on included."""
        now, out = time.perf_counter(), dict(self._seconds)
        for name, (start, _) in self._running.items():
            out[name] = out.get(name, 0.0) + now - start
        return out

    @property
    def cpu_seconds(self) -> dict[str, float]:
        """The same of CPU time, by all processes of the run; NaN where it is not known."""
        out = dict(self._cpu_seconds)
        if self._running:
            now = cpu_seconds()
            for name, (_, start) in self._running.items():
                out[name] = out.get(name, 0.0) + now - start
        return out

    def spent(self) -> dict[str, dict[str, float]]:
        """What a summary says of the time: ``seconds``, and ``cpu_utilisation`` of the cores where it is known."""
        seconds, cores = self.seconds, available_cores()
        used = {
            # Clock ticks of other processes are coarse: in a short phase they may sum up to more than there was.
            name: round(min(max(busy / (seconds[name] * cores), 0.0), 1.0), 3)
            for name, busy in self.cpu_seconds.items()
            if not math.isnan(busy) and seconds.get(name)
        }
        rounded = {name: round(value, 1) for name, value in seconds.items()}
        return {"seconds": rounded, **({"cpu_utilisation": used} if used else {})}

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the block's seconds, and what the cores did in them, to those of a kind of work."""
        self._running[name] = time.perf_counter(), cpu_seconds()
        yield
        self._seconds, self._cpu_seconds = self.seconds, self.cpu_seconds
        del self._running[name]

    def state_dict(self) -> dict[str, Any]:
        """Counters and seconds."""
        return {
            "phases": list(self.phases),
            "collected": self.collected,
            "updated": self.updated,
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken."""
        self.phases = list(state_dict["phases"])
        self.collected, self.updated = state_dict["collected"], state_dict["updated"]
        self._seconds = dict(state_dict["seconds"])
        unknown = dict.fromkeys(self._seconds, math.nan)  # in states of earlier versions
        self._cpu_seconds = dict(state_dict.get("cpu_seconds", unknown))


class Worlds:
    """The random streams of environments, from which their next episodes begin.

    Args:
        env: transforms on one of :mod:`ls3_envs`.
    """

    def __init__(self, env: TransformedEnv) -> None:
        self._env = env

    def state_dict(self) -> dict[str, Any]:
        """As they stood before the episodes that are going on."""
        return {"streams": self._env.base_env.random_state()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """The next reset begins those episodes again."""
        self._env.base_env.set_random_state(state_dict["streams"])


class HeldRandomState:
    """Python's, NumPy's and PyTorch's random streams, which take up a loaded state when all else is made."""

    def __init__(self) -> None:
        self._streams = GlobalRNGState()
        self._held: Mapping[str, Any] | None = None

    def state_dict(self) -> dict[str, Any]:
        """The state that is held, or else the streams now."""
        return dict(self._streams.state_dict() if self._held is None else self._held)

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Hold a state until :meth:`release`."""
        self._held = state_dict

    def release(self) -> None:
        """Let the streams take up the state that is held, if one is."""
        if self._held is not None:
            self._streams.load_state_dict(self._held)
            self._held = None
