"""Where the seed of an environment comes from that was given none, so that no two processes live the same life."""

from __future__ import annotations

import multiprocessing
import os
from typing import Any

import torch

from ls3_envs._checks import whole_number


class _Process:
    """The process that this is: a forked one inherits every variable, so its id is drawn anew after the fork."""

    def __init__(self) -> None:
        self.id = os.urandom(16)
        self.is_worker = multiprocessing.parent_process() is not None

    def begin_as_fork(self) -> None:
        self.id, self.is_worker = os.urandom(16), True


_PROCESS = _Process()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_PROCESS.begin_as_fork)


def process_id() -> bytes:
    """What no other process has, forked ones and those on other machines included."""
    return _PROCESS.id


def unused_seed() -> int:
    """A seed for an environment that was given none.

    In a program's main process PyTorch's global generator decides, so that ``torch.manual_seed`` repeats everything. A
    worker process may have that generator from its parent, as its siblings have: there the operating system decides.
    """
    drawn = int(torch.randint(2**31 - 1, ()))
    return int.from_bytes(os.urandom(8), "little") if _PROCESS.is_worker else drawn


def checked_seed(seed: Any, name: str = "seed") -> int:
    """The seed as an int; ``TypeError`` for what is no whole number, ``ValueError`` for a negative one."""
    return whole_number(seed, name, least=0)
