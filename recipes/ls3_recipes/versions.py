"""What decides what a run does, beside its settings: code, packages and processor."""

from __future__ import annotations

import platform
from functools import lru_cache
from hashlib import blake2b
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import ls3_envs
import ls3_recipes
import ls3_torchrl
from ls3_recipes.device import processor

#: Of a run's folder.
FORMAT = "ls3_recipes.run"
VERSION = 6
PACKAGES = ("torch", "torchrl", "tensordict", "numpy", "mujoco", "mujoco-warp", "hydra-core", "ls3-torchrl")


@lru_cache(maxsize=1)
def code() -> str:
    """A digest of all code and settings files that decide what a run does."""
    digest = blake2b(digest_size=16)
    for package in (ls3_torchrl, ls3_envs, ls3_recipes):
        folder = Path(str(package.__file__)).parent
        for path in sorted(p for p in folder.rglob("*") if p.suffix in (".py", ".yaml")):
            digest.update(f"{path.relative_to(folder)}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def description(data: str | None) -> dict[str, Any]:
    """What ``versions.json`` of a run that starts now says.

    Args:
        data: the folder of episodes that it is given.
    """
    about = {"format": FORMAT, "version": VERSION, "code": code(), "processor": processor()}
    return {**about, "data": None if data is None else _digest(Path(data)), **versions()}


def _digest(data: Path) -> str:
    """Of a folder of episodes: of its descriptions, which hold checksums of the rest."""
    digest = blake2b(digest_size=16)
    for path in sorted(data.rglob("*.json")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Versions of the packages that decide what a run does."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # run from a clone that is not installed
            found[name] = "not installed"
    return found
