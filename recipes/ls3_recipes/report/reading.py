"""What the folders of runs tell."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ls3_recipes.run_files import is_finished, read_json, read_metrics, read_yaml

#: Figures of an episode: name in the metrics, name in the summary, name in rollouts, heading.
FIGURES = (
    ("mean_success", "success_rate", "success", "success"),
    ("mean_violation", "violation_rate", "violation", "violations"),
    ("mean_return", "return_mean", "return", "return"),
)
#: Settings that say where a run lies and on what it was computed, and not what it does.
PLACES = (
    "output",
    "data",
    "scratch_dir",
    "vae.checkpoint",
    "checkpoint_minutes",
    "pictures",
    "tracker",
    "device",
    "threads",
)
#: Of these, what may still tell one run from another: seeds usually have data and VAEs of their own.
GIVEN = ("data", "vae.checkpoint")
_REMEDY = "Restore the file, or leave the run out."


class Rollouts(NamedTuple):
    """How the agent of every update did.

    Attributes:
        episodes: online episodes that each had learnt from, ``[U]``.
        figures: of each of its own episodes by name, ``[U, n]`` each.
    """

    episodes: np.ndarray
    figures: dict[str, np.ndarray]


class Run(NamedTuple):
    """What a run folder tells.

    Attributes:
        folder: of the run.
        algorithm: as in ``summary.json``.
        task: its domain.
        seed: its seed.
        settings: by their full names, without those that say where it lies.
        given: the data and the VAE that it was given; of those that a sweep shares out, the sweep's folder.
        data: a digest of the data that it was given, and the name of the VAE.
        summary: the whole of it.
        episodes: online episodes before each update, ``[U]``.
        curves: figures of each update's episodes by their name in the metrics, ``[U]`` each.
        rollouts: of the agent of each update, where there are any.
    """

    folder: Path
    algorithm: str
    task: str
    seed: int
    settings: dict[str, Any]
    given: dict[str, Any]
    data: tuple[str | None, str | None]
    summary: dict[str, Any]
    episodes: np.ndarray
    curves: dict[str, np.ndarray]
    rollouts: Rollouts | None


def run_folders(folders: Iterable[str | Path]) -> tuple[list[Path], list[Path]]:
    """The finished runs in folders, and those that are not.

    Args:
        folders: of runs, or with runs anywhere below them; VAEs that runs share, and evaluations, are left out.

    Raises:
        FileNotFoundError: for a folder without any run.
    """
    found: dict[Path, Path] = {}
    for folder in folders:
        below = [path.parent for path in _configurations(Path(folder))]
        if not below:
            raise FileNotFoundError(
                f"{folder} holds no run: there is no config.yaml in it, nor anywhere below. Pass folders of ls3 train "
                "or ls3 sweep."
            )
        found |= {path.resolve(): path for path in below}
    runs = [*found.values()]
    return [run for run in runs if is_finished(run)], [run for run in runs if not is_finished(run)]


def _configurations(folder: Path) -> Iterator[Path]:
    """Of runs in a folder; what lies within a run, such as its evaluations, is none."""
    if (folder / "config.yaml").is_file():
        if _is_run(folder):
            yield folder / "config.yaml"
    elif folder.is_dir():
        for inner in sorted(path for path in folder.iterdir() if path.is_dir()):
            yield from _configurations(inner)


def _is_run(folder: Path) -> bool:
    """Whether a folder with settings is that of a run, and not of a VAE that runs share, or of an evaluation."""
    shared = folder.resolve().parent.name == "shared" and folder.resolve().name.startswith("vae-")
    return not shared and not (folder / "vae.pt").is_file() and "run" not in read_yaml(folder / "config.yaml")


def read_run(folder: str | Path) -> Run:
    """Read a finished run.

    Raises:
        FileNotFoundError: when one of its files is missing.
        ValueError: for a file that is damaged.
    """
    folder = Path(folder)
    path = folder / "summary.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} is no folder of a finished run: summary.json is missing. Finish the run with ls3 train "
            f"resume={folder}, or leave it out."
        )
    summary = read_json(path)
    _check_summary(summary, path)
    rows = [row for row in read_metrics(folder) if row["phase"] == "online"]
    curves = {name: np.array([float(r["value"]) for r in rows if r["name"] == name]) for name, *_ in FIGURES}
    episodes = np.array([int(r["step"]) for r in rows if r["name"] == FIGURES[0][0]], dtype=int)
    lengths = {len(curve) for curve in curves.values()} | {len(episodes)}
    if len(lengths) > 1 or (lengths == {0} and "online" in summary):
        raise ValueError(
            f"{folder / 'metrics.csv'} is damaged: its online episodes do not have all of {', '.join(curves)}. "
            f"{_REMEDY}"
        )
    settings = flat(read_yaml(folder / "config.yaml"))
    data, vae = (settings.get(name) for name in GIVEN)
    for name in (*PLACES, "seed"):
        settings.pop(name, None)
    return Run(
        folder=folder,
        algorithm=summary.get("algorithm", "ls3"),
        task=summary["task"],
        seed=summary["seed"],
        settings=settings,
        given={name: _sweep_of(path) for name, path in zip(GIVEN, (data, vae), strict=True)},
        data=(_digest_of(folder) or data, None if vae is None else "/".join(Path(vae).parts[-2:])),
        summary=summary,
        episodes=episodes,
        curves=curves,
        rollouts=_read_rollouts(folder),
    )


def _sweep_of(path: str | None) -> str | None:
    """The folder of the sweep that shares a file or folder out, or the path as it is."""
    above = Path(path).parts if path is not None else ()
    return str(Path(*above[: above.index("shared")])) if "shared" in above[1:] else path


def _digest_of(folder: Path) -> str | None:
    """Of the data that a run was given, as it has noted it."""
    path = folder / "versions.json"
    return read_json(path).get("data") if path.is_file() else None


def flat(settings: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Nested settings by their full names.

    Example:
        >>> flat({"seed": 0, "planner": {"horizon": 5}})
        {'seed': 0, 'planner.horizon': 5}
    """
    out: dict[str, Any] = {}
    for name, value in settings.items():
        out |= flat(value, f"{where}{name}.") if isinstance(value, Mapping) else {where + name: value}
    return out


def _read_rollouts(folder: Path) -> Rollouts | None:
    """Where every agent has acted in as many episodes."""
    parts = [read_json(path) for path in sorted((folder / "rollouts").glob("agent_*.json"))]
    names = [name for *_, name, _ in FIGURES]
    for path, part in zip(sorted((folder / "rollouts").glob("agent_*.json")), parts, strict=True):
        if not {"online_episodes", *names} <= part.keys():
            raise ValueError(f"{path} is damaged: it lacks {', '.join(names)} or online_episodes. {_REMEDY}")
    if not parts or len({len(part["return"]) for part in parts}) > 1:
        return None
    parts.sort(key=lambda part: part["online_episodes"])
    figures = {name: np.array([part[name] for part in parts], dtype=float) for name in names}
    return Rollouts(np.array([part["online_episodes"] for part in parts]), figures)


def _check_summary(summary: Mapping[str, Any], path: Path) -> None:
    """Refuse a summary that lacks what a report shows."""

    def require(there: bool, what: str) -> None:
        if not there:
            raise ValueError(f"{path} is damaged: it lacks {what}. {_REMEDY}")

    require(isinstance(summary.get("task"), str), "the name of a task")
    require(isinstance(summary.get("algorithm", "ls3"), str), "the name of an algorithm")
    require(type(summary.get("seed")) is int, "a seed")
    require(type(summary.get("minutes")) in (int, float), "its minutes")
    for part in ("demonstrations", "online", "evaluation"):
        if part in summary:
            for _, name, *_ in FIGURES:
                figures = summary[part]
                there = isinstance(figures, Mapping) and type(figures.get(name)) in (int, float)
                require(there, f"the number {part}.{name}")
