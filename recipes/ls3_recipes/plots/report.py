"""What a report says of several runs: success, violations and return against online episodes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ls3_recipes.plots.style import INK, Label, grid, picture
from ls3_recipes.run_files import read_json, read_metrics

#: How algorithms are shown, in the order of legend and table.
Labels = Mapping[str, Label]
#: In place of a figure that no run has.
NOTHING = "–"
#: Figures of an episode: name in the metrics, name in the summary, heading.
FIGURES = (
    ("mean_success", "success_rate", "success"),
    ("mean_violation", "violation_rate", "violations"),
    ("mean_return", "return_mean", "return"),
)


_REMEDY = "Restore the file, or leave the run out."


class Run(NamedTuple):
    """What a run folder tells.

    Attributes:
        algorithm: as in ``summary.json``.
        seed: its seed.
        summary: the whole of it.
        episodes: online episodes after each update, ``[U]``.
        curves: figures of each update's episodes by their name in the metrics, ``[U]`` each.
    """

    algorithm: str
    seed: int
    summary: dict
    episodes: np.ndarray
    curves: dict[str, np.ndarray]


def read_run(folder: str | Path) -> Run:
    """Read a finished run.

    Raises:
        FileNotFoundError: when the folder holds no ``summary.json`` or ``metrics.csv``.
        ValueError: for a file that is damaged.
    """
    folder = Path(folder)
    path = folder / "summary.json"
    if not path.is_file():
        unfinished = (folder / "config.yaml").is_file()
        raise FileNotFoundError(
            f"{folder} is no folder of a finished run: summary.json is missing."
            + (f" Finish the run with ls3 train resume={folder}, or leave it out." if unfinished else "")
        )
    summary = read_json(path)
    _check_summary(summary, path)
    rows = [row for row in read_metrics(folder) if row["phase"] == "online"]
    curves = {name: np.array([float(r["value"]) for r in rows if r["name"] == name]) for name, _, _ in FIGURES}
    episodes = np.array([int(r["step"]) for r in rows if r["name"] == FIGURES[0][0]], dtype=int)
    if {len(curve) for curve in curves.values()} != {len(episodes)}:
        raise ValueError(
            f"{folder / 'metrics.csv'} is damaged: its online episodes do not have all of {', '.join(curves)}. "
            f"{_REMEDY}"
        )
    return Run(summary.get("algorithm", "ls3"), summary["seed"], summary, episodes, curves)


def _check_summary(summary: Mapping[str, Any], path: Path) -> None:
    """Refuse a summary that lacks what a report shows."""

    def require(there: bool, what: str) -> None:
        if not there:
            raise ValueError(f"{path} is damaged: it lacks {what}. {_REMEDY}")

    require(isinstance(summary.get("task"), str), "the name of a task")
    require(isinstance(summary.get("algorithm", "ls3"), str), "the name of an algorithm")
    require(type(summary.get("seed")) is int, "a seed")
    for part in ("demonstrations", "online", "evaluation"):
        if part in summary:
            for _, name, _ in FIGURES:
                figures = summary[part]
                there = isinstance(figures, Mapping) and type(figures.get(name)) in (int, float)
                require(there, f"the number {part}.{name}")


def check_alike(runs: Sequence[Run]) -> None:
    """Refuse to compare what is not comparable.

    Raises:
        ValueError: when tasks or numbers of online episodes differ, or a seed of an algorithm comes twice.
    """
    tasks = sorted({run.summary["task"] for run in runs})
    if len(tasks) > 1:
        raise ValueError(f"The runs are of several tasks: {', '.join(tasks)}. Report each task on its own.")
    counts = sorted({tuple(run.episodes) for run in runs})
    if len(counts) > 1:
        shown = ", ".join(f"{len(count)} updates, {count[-1] if count else 0} episodes" for count in counts)
        raise ValueError(
            f"The runs had different online episodes ({shown}). Give all the same online.updates and "
            "online.episodes_per_update."
        )
    seen = [(run.algorithm, run.seed) for run in runs]
    twice = sorted({pair for pair in seen if seen.count(pair) > 1})
    if twice:
        raise ValueError(f"Seeds of one algorithm come twice: {twice}. Pass each run once.")


def mean_and_error(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean over the first axis (seeds) and its standard error, s / sqrt(n); zero for a single seed."""
    n = len(values)
    error = values.std(0, ddof=1) / np.sqrt(n) if n > 1 else np.zeros_like(values.mean(0))
    return values.mean(0), error


def grouped(runs: Sequence[Run], labels: Labels) -> dict[str, list[Run]]:
    """Runs by algorithm, in the order of their labels."""
    groups = defaultdict(list)
    for run in sorted(runs, key=lambda run: run.seed):
        groups[run.algorithm].append(run)
    return {name: groups[name] for name in sorted(groups, key=lambda n: [*labels, n].index(n))}


def label_of(name: str, labels: Labels) -> Label:
    """How an algorithm is shown; one that is not known is shown by its name."""
    return labels.get(name, Label(name, INK))


def rows_of(runs: Sequence[Run], labels: Labels) -> list[dict[str, str]]:
    """One row of the table for each algorithm: means over seeds ± their standard errors."""
    rows = []
    for name, group in grouped(runs, labels).items():
        row = {"algorithm": label_of(name, labels).title, "seeds": str(len(group))}
        for part in ("online", "evaluation"):
            for _, figure, heading in FIGURES:
                values = [run.summary[part][figure] for run in group if part in run.summary]
                rate = figure.endswith("rate")
                shown = _shown(*mean_and_error(np.array(values)), rate=rate) if values else NOTHING
                row[f"{part} {heading}"] = shown
        total = np.array([(run.curves["mean_violation"] * np.diff(run.episodes, prepend=0)).sum() for run in group])
        row["violating episodes"] = _shown(*mean_and_error(total)) if len(group[0].episodes) else NOTHING
        rows.append(row)
    return rows


def _shown(mean: Any, error: Any, *, rate: bool = False) -> str:
    """A mean and its error, in per cent where it is a rate; nothing where it is no number."""
    if not np.isfinite(mean):
        return NOTHING
    return f"{100 * mean:.0f} ± {100 * error:.0f} %" if rate else f"{mean:.1f} ± {error:.1f}"


def plot_report(runs: Sequence[Run], labels: Labels, path: Path) -> None:
    """The figures against online episodes: means over seeds, with bands of one standard error."""
    returns = [run.summary["demonstrations"]["return_mean"] for run in runs if "demonstrations" in run.summary]
    demonstrated = np.mean(returns) if returns else np.nan
    with picture(path, 1, 4, (15, 3.3)) as (figure, (axes,)):
        for name, group in grouped(runs, labels).items():
            episodes, label = group[0].episodes, label_of(name, labels)
            panels = [np.stack([run.curves[key] for run in group]) for key, _, _ in FIGURES]
            violating = np.cumsum(panels[1] * np.diff(episodes, prepend=0), axis=1)
            for axis, values in zip(axes, [*panels, violating], strict=True):
                mean, error = mean_and_error(values)
                width, marker = 2.4 if name == "ls3" else 1.5, "o" if len(episodes) == 1 else None
                axis.plot(episodes, mean, color=label.colour, lw=width, marker=marker, label=label.title)
                axis.fill_between(episodes, mean - error, mean + error, color=label.colour, alpha=0.15, lw=0)
        for axis, title in zip(axes, ("Success rate", "Violation rate", "Return", "Violating episodes"), strict=True):
            axis.set(title=title, xlabel="online episodes")
            grid(axis)
        axes[0].set_ylim(-0.03, 1.03)
        axes[1].set_ylim(-0.03, 1.03)
        if np.isfinite(demonstrated):
            axes[2].axhline(demonstrated, color=INK, lw=0.9, ls=":")
            axes[2].annotate("demonstrator", (axes[2].get_xlim()[1], demonstrated), ha="right", va="bottom", fontsize=7)
        if not len(runs[0].episodes):
            axes[0].annotate("no online episodes", (0.5, 0.5), xycoords="axes fraction", ha="center", fontsize=8)
        axes[0].legend(fontsize=7, loc="lower right")
        figure.tight_layout()
