"""The tables of a report: figures of groups, runs one by one, and settings side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ls3_recipes.report.groups import Group, differing
from ls3_recipes.report.reading import FIGURES, Run
from ls3_recipes.report.statistics import Estimate, estimate

#: In place of a figure that no run has.
NOTHING = "–"


def figures_of(groups: Sequence[Group]) -> list[dict[str, str]]:
    """One row for each group: interquartile means over runs with their intervals, violations by the mean."""
    rows = []
    for group in groups:
        row = {"algorithm": group.title, "seeds": str(len(group.runs))}
        for part in ("online", "evaluation"):
            for _, name, _, heading in FIGURES:
                values = [run.summary[part][name] for run in group.runs if part in run.summary]
                rate = name.endswith("rate")
                said = (
                    shown(estimate(np.array(values), trimmed=heading != "violations"), rate=rate) if values else NOTHING
                )
                row[f"{part} {heading}"] = said
        violating = np.array([violating_episodes(run) for run in group.runs])
        row["violating episodes"] = shown(estimate(violating, trimmed=False))
        row["minutes"] = f"{np.median([run.summary['minutes'] for run in group.runs]):.0f}"
        rows.append(row)
    return rows


def violating_episodes(run: Run) -> float:
    """Online episodes of a run that violated."""
    return float((run.curves["mean_violation"] * np.diff(run.episodes, prepend=0)).sum())


def shown(value: Estimate, *, rate: bool = False) -> str:
    """A mean and its interval, in per cent where it is a rate; nothing where it is no number.

    Example:
        >>> shown(Estimate(np.array(0.95), np.array(0.9), np.array(1.0)), rate=True)
        '95 % [90, 100]'
    """
    if not np.isfinite(value.middle):
        return NOTHING
    factor, digits, unit = (100, 0, " %") if rate else (1, 1, "")
    middle, low, high = (f"{factor * float(part):.{digits}f}".replace("-", "−") for part in value)
    return f"{middle}{unit}" if np.isnan(value.low) else f"{middle}{unit} [{low}, {high}]"


def runs_one_by_one(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """One row for each run, for a spreadsheet."""
    rows = []
    for group in groups:
        for run in group.runs:
            row: dict[str, Any] = {"task": run.task, "group": group.title, "seed": run.seed}
            row |= {name: run.settings.get(name) for name in group.changes}
            for part in ("online", "evaluation"):
                row |= {f"{part}_{name}": run.summary.get(part, {}).get(name) for _, name, *_ in FIGURES}
            row |= {"violating_episodes": violating_episodes(run), "minutes": run.summary["minutes"]}
            rows.append(row | {"folder": str(run.folder)})
    return rows


def curves_one_by_one(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """One row for each round of online episodes, and for each agent that was rolled out."""
    rows = []
    for group in groups:
        for run in group.runs:
            named = {"task": run.task, "group": group.title, "seed": run.seed}
            for i, episodes in enumerate(run.episodes):
                figures = {heading: float(run.curves[name][i]) for name, _, _, heading in FIGURES}
                rows.append(named | {"kind": "online", "episodes": int(episodes)} | figures)
            if run.rollouts is not None:
                for i, episodes in enumerate(run.rollouts.episodes):
                    figures = {heading: float(run.rollouts.figures[name][i].mean()) for _, _, name, heading in FIGURES}
                    rows.append(named | {"kind": "rollouts", "episodes": int(episodes)} | figures)
    return rows


def settings_side_by_side(groups: Sequence[Group]) -> list[tuple[str, list[str], bool]]:
    """Every setting of every group, and whether groups that have it differ in it."""
    settings = [group.runs[0].settings for group in groups]
    marked = set(differing(settings))
    names = list(dict.fromkeys(name for one in settings for name in one))
    rows = []
    for name in names:
        values = [_said(one[name]) if name in one else "" for one in settings]
        rows.append((name, values, name in marked and len({value for value in values if value}) > 1))
    return sorted(rows, key=lambda row: not row[2])


def _said(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
