"""Writes a report: one page that holds everything, with its pictures, films and tables beside it."""

from __future__ import annotations

import base64
import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.console import console
from ls3_recipes.plots.style import draw
from ls3_recipes.report.films import Film, films_of
from ls3_recipes.report.groups import Group, grouped
from ls3_recipes.report.maps import has_maps, plot_maps
from ls3_recipes.report.plots import has_rollouts, plot_learning, plot_rollouts, plot_sensitivity, swept
from ls3_recipes.report.reading import Run, read_run, run_folders
from ls3_recipes.report.tables import curves_one_by_one, figures_of, runs_one_by_one, settings_side_by_side
from ls3_torchrl.files import save_text_atomically

#: How algorithms are shown, in the order of legend and table.
LABELS = {name: label for row in ALGORITHMS.values() for name, label in row.load().labels.items()}
#: Pictures by the ends of their files' names: titles and captions.
CAPTIONS = {
    "rollouts": (
        "Agents through training",
        "The agent of every update in episodes of its own, in which it neither explores nor learns, as in Figure 1.",
    ),
    "learning": ("Online episodes", "The episodes in which the agent learnt, round by round."),
    "sensitivity": (
        "What the setting changes",
        "Each dot is a run: hollow for its online episodes, filled for the evaluation afterwards; lines are means.",
    ),
    "maps": (
        "What the agent knew",
        "Value, safe set and constraint over the plane, and where the agent went in the episodes that followed. Values "
        "from low (dark) to high (light), on a scale of each map's own; probabilities from 0 (pale) to 1.",
    ),
}


@dataclass
class Part:
    """What the page says of one task.

    Args:
        task: its name.
        groups: of its runs.
        pictures: files of its pictures, by the ends of their names.
        films: best and worst episodes, with the titles of their groups.
    """

    task: str
    groups: list[Group]
    pictures: dict[str, Path] = field(default_factory=dict)
    films: list[tuple[str, Film]] = field(default_factory=list)


class Report(NamedTuple):
    """What was reported.

    Attributes:
        parts: what the page says, task by task.
        left_out: runs that could not be read, with their errors.
    """

    parts: list[Part]
    left_out: dict[str, str]


def write_report(
    folders: Sequence[str | Path], output: Path, title: str, failures: Mapping[str, str] | None = None
) -> Report:
    """Read runs, and write ``report.html``, pictures, films, ``runs.csv`` and ``curves.csv``.

    Args:
        folders: of runs, or with runs below them.
        output: where to; files that are there are overwritten.
        title: of the page.
        failures: errors of jobs that failed, by name.

    Returns:
        What the page says, and which runs it leaves out because they are damaged.

    Raises:
        FileNotFoundError: for a folder without runs.
        ValueError: for a run that comes twice, or no finished run that can be read.
    """
    finished, unfinished = run_folders(folders)
    if not finished:
        raise ValueError(
            f"None of the {len(unfinished)} runs is finished; ls3 train resume={unfinished[0]} goes on with one."
        )
    runs, left_out = _read(finished)
    tasks = sorted({run.task for run in runs})
    parts = [Part(task, grouped([run for run in runs if run.task == task], LABELS)) for task in tasks]
    output.mkdir(parents=True, exist_ok=True)
    for part in parts:
        _draw(part, output)
    _write_csv(output / "runs.csv", [row for part in parts for row in runs_one_by_one(part.groups)])
    _write_csv(output / "curves.csv", [row for part in parts for row in curves_one_by_one(part.groups)])
    page = _page(title, runs, parts, {**(failures or {}), **left_out}, [str(folder) for folder in unfinished])
    save_text_atomically(page, output / "report.html")
    return Report(parts, left_out)


def _read(folders: Sequence[Path]) -> tuple[list[Run], dict[str, str]]:
    """The runs in folders, and what is wrong with those that are damaged."""
    runs, left_out = [], {}
    for folder in folders:
        try:
            runs.append(read_run(folder))
        except (ValueError, OSError) as error:
            left_out[str(folder)] = " ".join(str(error).split())
            console.print(f"Left out: {left_out[str(folder)]}", markup=False, highlight=False, soft_wrap=True)
    if not runs:
        raise ValueError(f"No run can be read: {next(iter(left_out.values()))}")
    return runs, left_out


def _draw(part: Part, output: Path) -> None:
    """Pictures and films of one task; one that fails costs nothing but itself."""
    groups, paths = part.groups, {name: output / f"{part.task}-{name}.png" for name in CAPTIONS}
    plots: dict[str, Any] = {"learning": lambda: plot_learning(groups, paths["learning"])}
    if has_rollouts(groups):
        plots = {"rollouts": lambda: plot_rollouts(groups, paths["rollouts"])} | plots
    if (setting := swept(groups)) is not None:
        plots["sensitivity"] = lambda: plot_sensitivity(groups, setting, paths["sensitivity"])
    mapped = next((group.runs[0] for group in groups if group.algorithm == "ls3"), None)
    if mapped is not None and has_maps(mapped):
        plots["maps"] = lambda: plot_maps(mapped, paths["maps"])
    for number, group in enumerate(groups, start=1):
        name = _slug(f"{part.task}-{number}-{group.title}")
        plots[f"films of {group.title}"] = lambda group=group, name=name: part.films.extend(
            (group.title, film) for film in films_of(group.runs, output, name)
        )
    failed = draw(plots)
    part.pictures = {name: paths[name] for name in plots if name in paths and name not in failed}


def _slug(text: str) -> str:
    """A text as the beginning of a file's name, which must not be too long."""
    return re.sub(r"[^\w.+-]+", "_", text, flags=re.ASCII)[:120]


def _page(
    title: str, runs: Sequence[Run], parts: Sequence[Part], failures: dict[str, str], unfinished: Sequence[str]
) -> str:
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    presets = ", ".join(sorted({str(run.settings.get("preset")) for run in runs}))
    minutes = sum(run.summary["minutes"] for run in runs)
    took = f"{minutes / 60:.1f} hours" if minutes >= 60 else f"{minutes:.0f} minutes"
    hardware = sorted({str(run.summary.get("hardware", {}).get("cpu", "unknown")) for run in runs})
    about = f"{len(runs)} runs, preset {presets}, {took} in all, on {', '.join(hardware)}"
    return environment.get_template("page.html.j2").render(
        title=title, about=about, parts=[_shown(part) for part in parts], failures=failures, unfinished=unfinished
    )


def _shown(part: Part) -> dict[str, Any]:
    """What the page's template reads of one task."""
    rows = figures_of(part.groups)
    return {
        "task": part.task,
        "heading": part.task.replace("_", " ").capitalize(),
        "groups": [group.title for group in part.groups],
        "rows": [(group.colour, row) for group, row in zip(part.groups, rows, strict=True)],
        "pictures": [
            {"title": CAPTIONS[name][0], "caption": CAPTIONS[name][1], "data": _embedded(path)}
            for name, path in part.pictures.items()
        ],
        "films": [
            {"group": title, "caption": film.caption, "data": _embedded(film.path)} for title, film in part.films
        ],
        "settings": settings_side_by_side(part.groups),
        "runs": runs_one_by_one(part.groups),
    }


def _embedded(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()


def _write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    table = csv.DictWriter(text, names)
    table.writeheader()
    table.writerows(rows)
    save_text_atomically(text.getvalue(), path)
