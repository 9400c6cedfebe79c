"""What needs the packages of the extra ``recipes``, and what is said where one of them is missing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

#: Packages of the extra without which no command runs.
EXTRA = (
    *("hydra", "omegaconf", "matplotlib", "PIL", "av", "scipy", "rich", "tensorboard"),
    *("gymnasium", "mujoco", "mujoco_warp", "cv2"),
)


@contextmanager
def remedy_named(who: str) -> Iterator[None]:
    """End the process with one line where a package of the extra is not installed.

    Args:
        who: the command, as the line names it.

    Raises:
        SystemExit: with that line.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in EXTRA:
            raise
        raise SystemExit(f"{who} needs {error.name}: pip install 'ls3-torchrl[recipes]'.") from None


@dataclass(frozen=True)
class Job:
    """What a command does, by its address, imported when its settings are known to be right.

    PyTorch, TorchRL and MuJoCo take seconds to be imported, which neither a help text nor a refusal needs.

    Args:
        who: the command, as it is named where a package is missing.
        address: ``"package.module:name"`` of a function.

    Example:
        >>> Job("ls3 divide", "math:gcd")(12, 18)
        6
    """

    who: str
    address: str

    def load(self) -> Any:
        """The function."""
        module, _, name = self.address.partition(":")
        with remedy_named(self.who):
            return getattr(import_module(module), name)

    def __call__(self, *args: Any, **options: Any) -> Any:
        """Call the function."""
        return self.load()(*args, **options)
