"""Runs that differ in their seeds alone, and what tells one such group from another."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ls3_recipes.plots.style import INK, Label
from ls3_recipes.report.reading import Run

#: How algorithms are shown, in the order of legend and table.
Labels = Mapping[str, Label]
#: Settings by the symbols of the paper, and what ``null`` means there.
SYMBOLS = {
    "planner.constraint_threshold": ("δ_C", "no constraints"),
    "planner.safe_set_threshold": ("δ_S", "no safe set"),
    "planner.horizon": ("H", ""),
    "policy.penalty": ("λ", ""),
    "policy.risk.gamma": ("γ_risk", ""),
    "policy.risk.threshold": ("ε_risk", ""),
}
#: Settings that a group's name gives before it says how many more there are.
_SHOWN = 3


@dataclass(frozen=True)
class Group:
    """Runs of one algorithm and one setting.

    Args:
        title: what people know it by.
        algorithm: of all its runs.
        changes: settings in which it differs from other groups of its algorithm, by name.
        runs: one for each seed.
        colour: of its curves.
    """

    title: str
    algorithm: str
    changes: dict[str, Any]
    runs: list[Run]
    colour: str


def grouped(runs: Sequence[Run], labels: Labels) -> list[Group]:
    """Groups of the runs of one task, in the order of their algorithms' labels and then of their settings.

    Raises:
        ValueError: when a run comes twice.
    """
    by_algorithm = defaultdict(list)
    for run in sorted(runs, key=lambda run: run.seed):
        by_algorithm[run.algorithm].append(run)
    groups = []
    for name in sorted(by_algorithm, key=lambda name: [*labels, name].index(name)):
        groups += _of_algorithm(name, by_algorithm[name], labels.get(name, Label(name, INK)))
    return groups


def _of_algorithm(name: str, runs: Sequence[Run], label: Label) -> list[Group]:
    names = differing([run.settings for run in runs])
    alone = [(run.seed, *(repr(run.settings.get(key)) for key in names)) for run in runs]
    whole = [(*one, run.data) for one, run in zip(alone, runs, strict=True)]
    if len({*alone}) < len(alone) and len({*whole}) == len(whole):  # alike, but for the data that they were given
        runs = [run._replace(settings=run.settings | run.given) for run in runs]
        names = differing([run.settings for run in runs])
    by_settings: dict[tuple[str, ...], list[Run]] = defaultdict(list)
    for run in runs:
        by_settings[tuple(repr(run.settings.get(key)) for key in names)].append(run)
    ordered = sorted(by_settings.values(), key=lambda group: [_rank(group[0].settings.get(key)) for key in names])
    changed = [{key: group[0].settings.get(key) for key in names} for group in ordered]
    titles = [_title(label.title, changes, _SHOWN) for changes in changed]
    if len({*titles}) < len(titles):
        titles = [_title(label.title, changes, len(changes)) for changes in changed]
    groups = []
    for number, group in enumerate(ordered):
        seeds = [run.seed for run in group]
        if twice := {seed for seed in seeds if seeds.count(seed) > 1}:
            where = ", ".join(str(run.folder) for run in group if run.seed in twice)
            raise ValueError(
                f"Runs of {label.title} with the same settings and seed come twice: {where}. Leave one out."
            )
        colour = label.colour if len(ordered) == 1 else _shade(number, len(ordered))
        groups.append(Group(titles[number], name, changed[number], group, colour))
    return groups


def differing(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of settings that are not the same in all of several.

    Example:
        >>> differing([{"H": 3, "N": 5}, {"H": 4, "N": 5}])
        ['H']
    """
    names = list(dict.fromkeys(name for one in settings for name in one))
    return [name for name in names if len({repr(one.get(name)) for one in settings}) > 1]


def _rank(value: Any) -> tuple[int, float, str]:
    """Numbers by size, then words, then nothing."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return 0, float(value), ""
    return (2, 0.0, "") if value is None else (1, 0.0, str(value))


def _title(algorithm: str, changes: Mapping[str, Any], count: int) -> str:
    """Algorithm and the first settings in which it differs, and how many more there are."""
    shown = [said(name, value) for name, value in [*changes.items()][:count]]
    more = [f"{len(changes) - count} more"] if len(changes) > count else []
    return f"{algorithm}, {', '.join([*shown, *more])}" if changes else algorithm


def said(name: str, value: Any) -> str:
    """A setting as a legend has it.

    Example:
        >>> said("planner.safe_set_threshold", 0.8), said("planner.safe_set_threshold", None)
        ('δ_S = 0.8', 'no safe set')
    """
    symbol, absent = SYMBOLS.get(name, (name, ""))
    return absent if value is None and absent else f"{symbol} = {'none' if value is None else value}"


def _shade(number: int, count: int) -> str:
    """One of a row of colours from dark to light."""
    from matplotlib import colormaps, colors

    return colors.to_hex(colormaps["viridis"](0.9 * number / max(count - 1, 1)))
