"""Processes that imagine a part of the plans, forked from the one that plans."""

from __future__ import annotations

import io
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import warnings
import weakref
from collections.abc import Callable, Sequence
from functools import lru_cache
from multiprocessing.connection import Connection
from typing import Any, TypeVar

import torch
from torch import Tensor

#: Seconds after which a process that does not answer is given up, and between its looks at whether it is still wanted.
_SILENCE, _TICK = 60.0, 1.0


Item = TypeVar("Item")


class HelperError(RuntimeError):
    """A process has ended or fallen silent."""


@lru_cache(maxsize=1)
def _has_accelerator() -> bool:
    return torch.accelerator.is_available()


def may_fork() -> bool:
    """Whether forked processes can imagine: on Linux, without an accelerator, whose threads a fork would lose."""
    return sys.platform == "linux" and not multiprocessing.current_process().daemon and not _has_accelerator()


class Helpers:
    """Processes that call one function, as everything that it uses was when they were forked.

    Two threads of Python hand it over to each other at every operation; two processes do not.

    Args:
        function: called with what is sent, on one core.
        number: of processes.
    """

    def __init__(self, function: Callable[..., Any], number: int) -> None:
        context = multiprocessing.get_context("fork")
        self._owner = os.getpid()
        #: Held while they work: threads of one process must not read each other's answers.
        self.in_use = threading.Lock()
        self._connections: list[Connection] = []
        processes = []
        for _ in range(number):
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(function, theirs, os.getpid()), daemon=True)
            with warnings.catch_warnings():
                # Later Pythons warn of locks that other threads hold. These are idle, and silence is waited out.
                warnings.simplefilter("ignore", DeprecationWarning)
                process.start()
            theirs.close()
            self._connections.append(ours)
            processes.append(process)
        #: Ends the processes; when nobody needs them any more, it is called without being asked for.
        self.end = weakref.finalize(self, _end, processes, self._connections, os.getpid())

    def __len__(self) -> int:
        return len(self._connections)

    @property
    def are_mine(self) -> bool:
        """Whether this process has forked them; a fork of it must not talk to them."""
        return self._owner == os.getpid()

    def __call__(
        self, function: Callable[..., Any], items: Sequence[Item], arguments: Callable[[Item], tuple[Any, ...]]
    ) -> list[Any]:
        """What the function returns for each of several items, of which this process takes its share.

        Args:
            function: the same, which is not kept: it may be a method of what keeps this.
            items: of any kind.
            arguments: of the function for an item.

        Raises:
            HelperError: when a process has ended or fallen silent.
            Exception: what the function raises. After any, the processes are ended.
        """
        shares = len(self) + 1
        found: list[Any] = [None] * len(items)
        try:
            for i, connection in enumerate(self._connections, start=1):
                _send(connection, [arguments(item) for item in items[i::shares]])
            found[0::shares] = [function(*arguments(item)) for item in items[0::shares]]
            for i, connection in enumerate(self._connections, start=1):
                found[i::shares] = _receive(connection)
        except BaseException:
            self.end()
            raise
        return found


class _Pickler(pickle.Pickler):
    """Tensors as arrays: PyTorch's own way is for large ones."""

    def reducer_override(self, obj: Any) -> Any:
        return (torch.from_numpy, (obj.numpy(),)) if isinstance(obj, Tensor) else NotImplemented


def _send(connection: Connection, what: Any) -> None:
    buffer = io.BytesIO()
    _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(what)
    try:
        connection.send_bytes(buffer.getbuffer())
    except OSError as error:
        raise HelperError from error


def _receive(connection: Connection) -> list[Any]:
    try:
        if not connection.poll(_SILENCE):
            raise HelperError
        answer = pickle.loads(connection.recv_bytes())
    except (EOFError, OSError, pickle.UnpicklingError) as error:
        raise HelperError from error
    if isinstance(answer, Exception):
        raise answer
    return answer


def _serve(function: Callable[..., Any], connection: Connection, parent: int) -> None:
    """What a process does until nobody needs it."""
    for number in (signal.SIGINT, signal.SIGHUP):  # a terminal sends them to all; who has forked this process ends it
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    torch.set_num_threads(1)
    try:
        while True:
            while not connection.poll(_TICK):
                if os.getppid() != parent:
                    os._exit(0)
            calls = pickle.loads(connection.recv_bytes())
            answer: Any
            try:
                answer = [function(*call) for call in calls]
            except Exception as error:
                answer = error
            _send(connection, answer)
    except (EOFError, OSError, HelperError):
        pass  # nobody listens any more


def _end(processes: Sequence[Any], connections: Sequence[Connection], owner: int) -> None:
    if os.getpid() != owner:  # a fork of the owner, which has a copy of everything but these processes
        return
    for process in processes:
        process.kill()
    for process, connection in zip(processes, connections, strict=True):
        process.join()
        connection.close()
