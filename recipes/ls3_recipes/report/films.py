"""The best and the worst online episodes of a group of runs, as films."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from tensordict import TensorDictBase

from ls3_recipes.figures import episode_figures
from ls3_recipes.plots.films import save_film
from ls3_recipes.report.reading import Run
from ls3_torchrl.data import Tag, load_episodes


class Film(NamedTuple):
    """One episode.

    Attributes:
        caption: which it was, and how it went.
        path: of the film.
    """

    caption: str
    path: Path


class _Found(NamedTuple):
    rank: tuple[bool, float]
    run: Run
    folder: Path
    row: int
    text: str


def films_of(runs: Sequence[Run], folder: Path, name: str) -> list[Film]:
    """The best and the worst of all online episodes that lie beside the runs.

    Those that violated are worse than those that did not; then returns count.

    Args:
        runs: of a group.
        folder: that the films go to.
        name: of the group, in the films' names.

    Returns:
        Best and worst, one where all went equally well; nothing where the runs have no episodes any more.
    """
    found = list(_episodes(runs))
    if not found:
        return []
    films, best, worst = [], max(found, key=lambda f: f.rank), min(found, key=lambda f: f.rank)
    for word, chosen in (("Best", best), *([("Worst", worst)] if worst.rank < best.rank else [])):
        path = folder / f"{name}-{word.lower()}.mp4"
        save_film(path, _load(chosen.folder)[chosen.row][None])
        films.append(Film(f"{word}: {chosen.text}", path))
    return films


def _episodes(runs: Sequence[Run]) -> Iterator[_Found]:
    for run in runs:
        for folder in sorted((run.folder / "episodes").glob("update_*")):
            episodes = _load(folder)
            figures = episode_figures(episodes)
            update = int(folder.name.removeprefix("update_"))
            for row in range(len(episodes)):
                violated, returned = bool(figures["violation"][row]), float(figures["return"][row])
                success = "reached the goal" if figures["success"][row] else "did not reach the goal"
                text = (
                    f"seed {run.seed}, update {update}, return {returned:.0f}, {success}"
                    f"{', violated' if violated else ''}"
                )
                yield _Found((not violated, returned), run, folder, row, text)


def _load(folder: Path) -> TensorDictBase:
    return load_episodes(folder)[Tag.ONLINE]
