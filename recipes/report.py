"""Several runs in one picture and one table: success, violations and return against online episodes."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import hydra
import numpy as np
from matplotlib import pyplot as plt
from omegaconf import DictConfig
from rich.table import Table

from common import console, read_metrics
from pictures import INK, PALE, STYLE

#: Algorithms in the order of legend and table, with the names that people know them by.
NAMES = {"ls3": "LS³", "sacfd_rrl": "SACfD+RRL", "sacfd": "SACfD", "awac": "AWAC", "bc": "Behaviour cloning"}
COLOURS = {"ls3": "#1b7f79", "sacfd_rrl": "#d1495b", "sacfd": "#e0a458", "awac": "#5b6fb5", "bc": "#8d99a6"}
#: Figures of an episode: name in the metrics, name in the summary, heading.
FIGURES = (
    ("mean_success", "success_rate", "success"),
    ("mean_violation", "violation_rate", "violations"),
    ("mean_return", "return_mean", "return"),
)


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
        FileNotFoundError: when the folder holds no ``summary.json``.
    """
    folder = Path(folder)
    if not (folder / "summary.json").is_file():
        raise FileNotFoundError(f"{folder} is no folder of a finished run: summary.json is missing.")
    summary = json.loads((folder / "summary.json").read_text())
    rows = [row for row in read_metrics(folder) if row["phase"] == "online"]
    curves = {name: np.array([float(r["value"]) for r in rows if r["name"] == name]) for name, _, _ in FIGURES}
    episodes = np.array([int(r["step"]) for r in rows if r["name"] == FIGURES[0][0]])
    return Run(summary.get("algorithm", "ls3"), summary["seed"], summary, episodes, curves)


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


def grouped(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs by algorithm, in the order of :data:`NAMES`."""
    groups = defaultdict(list)
    for run in sorted(runs, key=lambda run: run.seed):
        groups[run.algorithm].append(run)
    return {name: groups[name] for name in sorted(groups, key=lambda n: [*NAMES, n].index(n))}


def rows_of(runs: Sequence[Run]) -> list[dict[str, str]]:
    """One row of the table for each algorithm: means over seeds ± their standard errors."""
    rows = []
    for name, group in grouped(runs).items():
        row = {"algorithm": NAMES.get(name, name), "seeds": str(len(group))}
        for part in ("online", "evaluation"):
            for _, figure, heading in FIGURES:
                values = [run.summary[part][figure] for run in group if part in run.summary]
                mean, error = mean_and_error(np.array(values)) if values else (np.nan, np.nan)
                share = figure.endswith("rate")
                row[f"{part} {heading}"] = (
                    f"{100 * mean:.0f} ± {100 * error:.0f} %" if share else f"{mean:.1f} ± {error:.1f}"
                )
        total = np.array([run.curves["mean_violation"].sum() * np.diff(run.episodes, prepend=0)[0] for run in group])
        mean, error = mean_and_error(total)
        row["violating episodes"] = f"{mean:.1f} ± {error:.1f}"
        rows.append(row)
    return rows


def draw(runs: Sequence[Run], path: Path) -> None:
    """The three figures against online episodes: means over seeds, with bands of one standard error."""
    teacher = np.mean([run.summary["demonstrations"]["return_mean"] for run in runs])
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, 4, figsize=(15, 3.3))
        for name, group in grouped(runs).items():
            episodes, colour = group[0].episodes, COLOURS.get(name, INK)
            panels = [np.stack([run.curves[key] for run in group]) for key, _, _ in FIGURES]
            violating = np.cumsum(panels[1] * np.diff(episodes, prepend=0), axis=1)
            for axis, values in zip(axes, [*panels, violating], strict=True):
                mean, error = mean_and_error(values)
                axis.plot(episodes, mean, color=colour, lw=2.4 if name == "ls3" else 1.5, label=NAMES.get(name, name))
                axis.fill_between(episodes, mean - error, mean + error, color=colour, alpha=0.15, lw=0)
        for axis, title in zip(axes, ("Success rate", "Violation rate", "Return", "Violating episodes"), strict=True):
            axis.set(title=title, xlabel="online episodes")
            axis.grid(color=PALE, alpha=0.4, lw=0.6)
        axes[0].set_ylim(-0.03, 1.03)
        axes[1].set_ylim(-0.03, 1.03)
        axes[2].axhline(teacher, color=INK, lw=0.9, ls=":")
        axes[2].annotate("teacher", (axes[2].get_xlim()[1], teacher), ha="right", va="bottom", fontsize=7)
        axes[0].legend(fontsize=7, loc="lower right")
        figure.tight_layout()
        figure.savefig(path)
        plt.close(figure)


def report(config: DictConfig) -> list[dict[str, str]]:
    """Draw and tabulate.

    Args:
        config: the resolved configuration of ``conf/report.yaml``.

    Returns:
        The table's rows.
    """
    folder = Path(config.output)
    if folder.exists():
        raise FileExistsError(f"The output folder {folder} exists already. Choose another with output=DIR.")
    if not config.runs:
        raise ValueError("No runs: pass runs=[DIR,DIR,...], folders of finished runs.")
    runs = [read_run(str(path)) for path in config.runs]
    check_alike(runs)
    rows = rows_of(runs)
    folder.mkdir(parents=True)
    draw(runs, folder / "comparison.png")
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
    lines += ["| " + " | ".join(row.values()) + " |" for row in rows]
    (folder / "comparison.md").write_text("\n".join(lines) + "\n")
    table = Table(title=f"{runs[0].summary['task']}: mean ± standard error over seeds")
    shown = [column for column in rows[0] if not column.startswith("online")]
    for column in shown:
        table.add_column(column.replace(" ", "\n", 1), justify="left" if column == "algorithm" else "right")
    for row in rows:
        table.add_row(*(row[column] for column in shown))
    console.print(table)
    console.print(f"Picture and table are in [bold]{folder}[/bold]")
    return rows


@hydra.main(version_base="1.3", config_path="conf", config_name="report")
def main(config: DictConfig) -> None:
    """Entry point."""
    report(config)


if __name__ == "__main__":
    main()
