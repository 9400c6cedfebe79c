"""The pictures of a report: curves through training, and what a setting changes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ls3_recipes.plots.style import INK, Axes, grid, picture
from ls3_recipes.report.groups import Group, said
from ls3_recipes.report.reading import FIGURES, Run
from ls3_recipes.report.statistics import Estimate, estimate

TITLES = ("Success rate", "Violation rate", "Return")


def plot_learning(groups: Sequence[Group], path: Path) -> None:
    """Online episodes as they went while the agent learnt, and all of them that violated so far."""
    with picture(path, 1, 4, (15, 3.6)) as (figure, (axes,)):
        for group in groups:
            for runs in _alike(group.runs):
                episodes = runs[0].episodes
                panels = [np.stack([run.curves[name] for run in runs]) for name, *_ in FIGURES]
                violating = np.cumsum(panels[1] * np.diff(episodes, prepend=0), axis=1)
                for axis, values, trimmed in zip(axes, [*panels, violating], (True, False, True, False), strict=True):
                    _curve(axis, group, episodes, estimate(values, trimmed=trimmed))
        for axis, title in zip(axes, (*TITLES, "Violating episodes so far"), strict=True):
            axis.set(title=title, xlabel="online episodes")
        most = max(1.0, axes[-1].get_ylim()[1])
        axes[-1].set_ylim(-0.03 * most, most)  # no violation is a line at the bottom, and no ups and downs round 0
        _finish(figure, axes, groups)


def plot_rollouts(groups: Sequence[Group], path: Path) -> None:
    """The agent of every update in episodes of its own, as in Figure 1."""
    with picture(path, 1, 3, (12, 3.6)) as (figure, (axes,)):
        for group in groups:
            done = [run.rollouts for run in group.runs if run.rollouts is not None]
            for episodes in {tuple(rollouts.episodes) for rollouts in done}:
                same = [rollouts for rollouts in done if tuple(rollouts.episodes) == episodes]
                for axis, (*_, name, _) in zip(axes, FIGURES, strict=True):
                    values = np.stack([rollouts.figures[name].mean(-1) for rollouts in same])
                    _curve(axis, group, np.array(episodes), estimate(values, trimmed=name != "violation"))
        for axis, title in zip(axes, TITLES, strict=True):
            axis.set(title=title, xlabel="training trajectories")
        _finish(figure, axes, groups)


def has_rollouts(groups: Iterable[Group]) -> bool:
    """Whether there is anything for :func:`plot_rollouts`."""
    return any(run.rollouts is not None for group in groups for run in group.runs)


def swept(groups: Sequence[Group]) -> str | None:
    """The one setting in which all groups of one algorithm differ, where it is a number or nothing."""
    names = {name for group in groups for name in group.changes}
    if len(names) != 1 or len({group.algorithm for group in groups}) != 1 or len(groups) < 2:
        return None
    values = [value for group in groups for value in group.changes.values()]
    numbers = [value for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
    return names.pop() if len(numbers) >= len(values) - 1 and len(numbers) > 1 else None


def plot_sensitivity(groups: Sequence[Group], name: str, path: Path) -> None:
    """Figures of training and of evaluation against a setting, each run as a dot."""
    with picture(path, 1, 3, (12, 3.4)) as (figure, (axes,)):
        places = np.arange(len(groups))
        for axis, (_, key, _, _), title in zip(axes, FIGURES, TITLES, strict=True):
            for part, shift, filled in (("online", -0.08, False), ("evaluation", 0.08, True)):
                shown = [[run.summary[part][key] for run in group.runs if part in run.summary] for group in groups]
                for place, group, values in zip(places, groups, shown, strict=True):
                    face = group.colour if filled else "white"
                    axis.scatter(
                        [place + shift] * len(values), values, s=22, fc=face, ec=group.colour, lw=1.1, zorder=3
                    )
                there = [i for i, values in enumerate(shown) if values]
                means = [np.mean(shown[i]) for i in there]
                axis.plot(
                    places[there] + shift, means, color=INK, lw=1.2, ls="-" if filled else ":", label=part, zorder=2
                )
            axis.set(title=title, xticks=places)
            axis.set_xticklabels([said(name, group.changes[name]).partition(" = ")[2] or "none" for group in groups])
            axis.set_xlabel(said(name, 0).partition(" = ")[0])
            _rates(axis, title)
            grid(axis)
        axes[0].legend(fontsize=8)
        figure.tight_layout()


def _alike(runs: Sequence[Run]) -> list[list[Run]]:
    """Runs with the same numbers of online episodes."""
    parts: dict[tuple[int, ...], list[Run]] = {}
    for run in runs:
        if len(run.episodes):
            parts.setdefault(tuple(run.episodes), []).append(run)
    return [*parts.values()]


def _curve(axis: Axes, group: Group, episodes: np.ndarray, values: Estimate) -> None:
    marker = "o" if len(episodes) == 1 else None
    width = 2.2 if group.algorithm == "ls3" else 1.5
    axis.plot(episodes, values.middle, color=group.colour, lw=width, marker=marker, label=group.title)
    axis.fill_between(episodes, values.low, values.high, color=group.colour, alpha=0.15, lw=0)


def _finish(figure: object, axes: Sequence[Axes], groups: Sequence[Group]) -> None:
    """Grids, the demonstrator's return, and one legend below."""
    returns = [
        run.summary["demonstrations"]["return_mean"]
        for group in groups
        for run in group.runs
        if "demonstrations" in run.summary
    ]
    for axis in axes:
        _rates(axis, axis.get_title())
        grid(axis)
    if returns:
        axis = axes[2]
        axis.axhline(np.mean(returns), color=INK, lw=0.9, ls=":")
        axis.annotate(
            "demonstrator",
            (1, np.mean(returns)),
            xycoords=("axes fraction", "data"),
            ha="right",
            va="bottom",
            fontsize=7,
        )
    handles = {label: line for axis in axes for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    if not handles:
        axes[0].annotate("no online episodes", (0.5, 0.5), xycoords="axes fraction", ha="center", fontsize=8)
    figure.tight_layout()  # type: ignore[attr-defined]
    if handles:
        figure.legend(  # type: ignore[attr-defined]
            handles.values(),
            handles,
            loc="upper center",
            bbox_to_anchor=(0.5, 0.02),
            ncol=min(len(handles), 5),
            fontsize=8,
        )


def _rates(axis: Axes, title: str) -> None:
    if title.endswith("rate"):
        axis.set_ylim(-0.03, 1.03)
