"""Which folder a run writes to: a new one, or that of the same run, which was cut off."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.markup import escape

from ls3_recipes.console import console
from ls3_recipes.options import as_dict
from ls3_recipes.run_files import is_finished, read_json, read_yaml, require_new, require_writable
from ls3_recipes.run_folder import RunFolder
from ls3_recipes.run_settings import RunSettings
from ls3_recipes.versions import FORMAT, VERSION, description

#: Where runs go that are given no ``output``.
RUNS = Path("runs")
#: Settings that say where a run and what it reads lie, and not what it does.
_PLACES = ("output", "data", "scratch_dir", "vae.checkpoint", "checkpoint_minutes", "pictures", "tracker")
#: What stands for a choice that was made when the run began.
_OPEN = {
    "device": "auto",
    "threads": None,
    "vae.autocast": "auto",
    "optim.autocast": "auto",
    "planner.precision": "auto",
}


def open_folder(settings: RunSettings) -> RunFolder:
    """A new folder for a run, or the one in which the same run was cut off.

    Without ``output``, a run below ``runs/`` with the same settings, the same code and the same packages: it ends in
    the same bits as one that starts afresh, only sooner.

    Args:
        settings: of the run, in which nothing is left open.

    Raises:
        FileExistsError: for an ``output`` that is no run, a finished one, one of other settings, or one that another
            process is writing to.
    """
    wanted = as_dict(settings)
    if settings.output is not None:
        path = Path(settings.output)
        if not path.exists():
            return RunFolder.make(path, wanted)
        require_same_run(path, wanted)
        return reopen(path, settings.data)
    for path in _cut_off(settings):
        with suppress(FileExistsError):  # another process is at it
            return reopen(path, settings.data)
    return _make_new(f"{name_of(settings)}-{datetime.now():%Y%m%d-%H%M%S}", wanted)


def begun_with(settings: RunSettings) -> dict[str, Any]:
    """The settings with which the run began that :func:`open_folder` will continue; none of a new one.

    Args:
        settings: of the run; what is left open in them was decided when it began.

    Raises:
        FileExistsError: for an ``output`` that cannot be continued.
        ValueError: for one that cannot be made.
    """
    if settings.output is None:
        require_writable(RUNS / "new", "output")
        there = next(_cut_off(settings), None)
        return {} if there is None else read_yaml(there / "config.yaml")
    if os.path.lexists(settings.output):
        return require_same_run(Path(settings.output), as_dict(settings))
    require_new(settings.output)
    return {}


def name_of(settings: RunSettings) -> str:
    """What a run without ``output`` is called, before the time."""
    what = [settings.task.name, settings.preset, f"seed{settings.seed}"]
    return "-".join(what if settings.algorithm == "ls3" else [settings.algorithm, *what])


def _make_new(name: str, wanted: Mapping[str, Any]) -> RunFolder:
    """Two runs that start in the same second get folders of their own."""
    number = 1
    while True:
        path = RUNS / (name if number == 1 else f"{name}-{number}")
        try:
            return RunFolder.make(path, {**wanted, "output": str(path)})
        except FileExistsError:
            number += 1


def _cut_off(settings: RunSettings) -> Iterator[Path]:
    """Folders below ``runs/`` of unfinished runs that would do the same, the newest first."""
    for path in sorted(RUNS.glob(f"{name_of(settings)}-*"), reverse=True):
        with suppress(OSError, ValueError):
            require_same_run(path, as_dict(settings))
            if read_json(path / "versions.json") == description(settings.data):
                yield path


def reopen(path: Path, data: str | None) -> RunFolder:
    """The folder of an unfinished run.

    Args:
        path: of the folder.
        data: the folder of episodes that it goes on with.

    Raises:
        FileExistsError: while another process writes to it, and for other episodes than those that it began with.
    """
    now, there = description(data), read_json(path / "versions.json")
    if now["data"] != there.get("data"):
        raise FileExistsError(
            f"The run in {path} began with other episodes than those in data={data}. Restore them, or choose another "
            "output=DIR."
        )
    folder = RunFolder(path)
    folder.tidy()
    console.print(f"Continuing the run in [bold]{escape(str(path))}[/bold], which was cut off.", soft_wrap=True)
    changed = [name for name, value in now.items() if there.get(name) != value]
    if changed:
        console.print(
            f"[bold red]{', '.join(changed)} changed since it began[/bold red]: what follows need not be what an "
            "uncut run would have done."
        )
    return folder


def require_same_run(path: Path, wanted: Mapping[str, Any]) -> dict[str, Any]:
    """The settings with which a run began; ``FileExistsError`` for a folder that holds no unfinished run of these."""
    if not (path / "config.yaml").is_file():
        require_new(path)
    there = require_same_settings(path, wanted)
    require_unfinished(path)
    return there


def require_same_settings(path: Path, wanted: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a run, finished or not; ``FileExistsError`` where they are others than those that are wanted."""
    there = read_yaml(path / "config.yaml")
    different = list(_differences(there, wanted))
    if different:
        raise FileExistsError(
            f"{path} holds a run of other settings: {'; '.join(different[:3])}. "
            "Choose another output=DIR, or give the settings of that run to continue it."
        )
    return there


def require_unfinished(path: Path) -> None:
    """Raise ``FileExistsError`` for a run that is finished, or that another version left, with states of its own."""
    if is_finished(path):
        raise FileExistsError(
            f"The run in {path} is finished, and no run overwrites another. Choose another output=DIR, or move it away."
        )
    about = read_json(path / "versions.json")
    if (about.get("format"), about.get("version")) != (FORMAT, VERSION):
        raise FileExistsError(
            f"{path} was left by another version of this program, whose states this one does not continue. "
            "Choose another output=DIR, or move it away."
        )


def _differences(there: Mapping[str, Any], wanted: Mapping[str, Any], where: str = "") -> Iterator[str]:
    """Settings that differ, but for choices that were made when the run began."""
    for key in sorted({*there, *wanted}):
        one, other = there.get(key), wanted.get(key)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            yield from _differences(one, other, f"{where}{key}.")
        elif one != other and where + key not in _PLACES and (where + key, other) not in _OPEN.items():
            yield f"{where}{key}={one!r} there, {other!r} here"
