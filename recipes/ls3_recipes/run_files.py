"""Files of a run: where they can be written, and reading them without trusting them."""

from __future__ import annotations

import csv
import io
import json
import os
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

#: Of ``metrics.csv``.
COLUMNS = ("seconds", "phase", "step", "name", "value")
#: Bytes that a file's name can have on all common file systems.
_LONGEST_NAME = 255


def require_new(path: str | Path) -> Path:
    """The path of an output folder that does not exist yet and can be made.

    Raises:
        FileExistsError: when it exists.
        ValueError: when it cannot be made.
    """
    path = Path(path)
    if os.path.lexists(path):
        raise FileExistsError(
            f"The output folder {path} exists already, and no run overwrites another. Choose another with output=DIR, "
            "or move the old one away."
        )
    require_writable(path, "output")
    return path


def require_writable(path: str | Path, name: str) -> None:
    """Refuse a file or folder that cannot be made, without making it.

    Args:
        path: of the file or folder.
        name: of the setting.

    Raises:
        ValueError: naming what is in the way.
    """
    parent = Path(path).absolute().parent
    while not os.path.lexists(parent) and parent != parent.parent:
        parent = parent.parent
    if not parent.is_dir():
        raise ValueError(f"{name}={path} cannot be made: {parent} is no folder. Choose another place.")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise ValueError(f"{name}={path} cannot be made: {parent} cannot be written to. Choose another place.")
    if any(len(os.fsencode(part)) > _LONGEST_NAME for part in Path(path).parts):
        raise ValueError(f"{name}={path} cannot be made: the name is too long. Choose a shorter one.")


def is_finished(path: str | Path) -> bool:
    """Whether nothing of a run is left to be done."""
    return (Path(path) / "summary.json").is_file() and not any((Path(path) / "checkpoints").glob("run-*"))


def require_folder(path: str | Path, name: str) -> None:
    """Refuse a folder to work in that is no folder, or that cannot be written to or made.

    Args:
        path: of the folder; it may exist.
        name: of the setting.

    Raises:
        ValueError: naming what is in the way.
    """
    path = Path(path)
    if not os.path.lexists(path):
        require_writable(path, name)
    elif not path.is_dir() or not os.access(path, os.W_OK | os.X_OK):
        raise ValueError(f"{name}={path} is no folder that can be written to. Choose another place.")


def read_metrics(folder: str | Path) -> list[dict[str, str]]:
    """The rows of a run's ``metrics.csv``; steps and values are numbers, NaN among them.

    Raises:
        FileNotFoundError: when there is none.
        ValueError: for a file that is damaged.
    """
    path = Path(folder) / "metrics.csv"
    rows = list(csv.DictReader(io.StringIO(_read_text(path, "the metrics of a run"))))
    for number, row in enumerate(rows, start=2):
        try:
            if None in row or None in row.values():
                raise ValueError
            int(row["step"]), float(row["value"]), row["phase"], row["name"]
        except (KeyError, ValueError):
            raise ValueError(
                f"{path} is damaged: line {number} has no {', '.join(COLUMNS)}. Restore the file, or leave the run out."
            ) from None
    return rows


def read_json(path: str | Path) -> dict[str, Any]:
    """A JSON file of a run.

    Raises:
        FileNotFoundError: when there is none.
        ValueError: for a file that is damaged.
    """
    try:
        content = json.loads(_read_text(Path(path), "a file of a run"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is damaged: it is no JSON ({error}). Restore the file, or run again.") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} is damaged: it holds no names with values. Restore the file, or run again.")
    return content


def read_yaml(path: str | Path) -> dict[str, Any]:
    """The settings in a YAML file.

    Raises:
        FileNotFoundError: when there is none.
        ValueError: for a file that is no YAML, or holds no settings.
    """
    try:
        content = OmegaConf.to_container(OmegaConf.create(_read_text(Path(path), "a file of settings")))
    except (yaml.YAMLError, OmegaConfBaseException) as error:
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())}. Mend the file.") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds no settings, but {type(content).__name__}. Write one KEY: VALUE a line.")
    return {str(key): value for key, value in content.items()}


def _read_text(path: Path, what: str) -> str:
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: {what}. Restore it, or run again.")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is damaged: it is no text in UTF-8 ({error}). Restore it, or save it as UTF-8."
        ) from None
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}. Allow it, or choose another.") from None
