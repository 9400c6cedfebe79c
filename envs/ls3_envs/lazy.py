"""Classes that are named now and imported when they are first used."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class Lazy:
    """A class or function by its address, imported at its first call: the table of domains needs no MuJoCo.

    Args:
        address: ``"package.module:Name"``.

    Raises:
        ValueError: for an address of another form.
        ModuleNotFoundError: by a call or :meth:`load`, when the module or a package that it needs is not installed.
        AttributeError: by a call or :meth:`load`, when the module has nothing of that name.

    Example:
        >>> Lazy("fractions:Fraction")(1, 2)
        Fraction(1, 2)
    """

    address: str

    def __post_init__(self) -> None:
        module, colon, name = self.address.partition(":")
        if not (colon and name.isidentifier() and all(part.isidentifier() for part in module.split("."))):
            raise ValueError(f"address must read 'package.module:Name', got {self.address!r}.")

    @property
    def module(self) -> str:
        """The module's full name."""
        return self.address.partition(":")[0]

    @property
    def name(self) -> str:
        """The name inside the module."""
        return self.address.partition(":")[2]

    def load(self) -> Any:
        """What the address names."""
        try:
            module = import_module(self.module)
        except ModuleNotFoundError as error:
            if error.name is not None and f"{self.module}.".startswith(f"{error.name}."):
                raise  # the address itself is wrong, and the message says which module there is none of
            raise ModuleNotFoundError(
                f"{self.name} needs the package {error.name!r}, which is not installed. "
                "The domains' packages come with: pip install 'ls3-torchrl[envs]'",
                name=error.name,
            ) from error
        if not hasattr(module, self.name):
            raise AttributeError(f"Module {self.module!r} has no {self.name!r}: check the address {self.address!r}.")
        return getattr(module, self.name)

    def __call__(self, *args: Any, **options: Any) -> Any:
        """Call what the address names."""
        return self.load()(*args, **options)
