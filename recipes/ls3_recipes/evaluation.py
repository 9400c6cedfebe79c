"""Episodes of what a run of any algorithm has trained."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.algorithms.settings.ls3 import LS3Settings
from ls3_recipes.command_settings import EvaluateSettings
from ls3_recipes.configuration import settings_of_run
from ls3_recipes.console import print_summary
from ls3_recipes.device import choose_device, hardware
from ls3_recipes.figures import episode_figures, summarise
from ls3_recipes.options import as_dict, defaults, errors_of
from ls3_recipes.plots.films import save_film
from ls3_recipes.plots.style import draw
from ls3_recipes.rollout import make_env, run_episodes
from ls3_recipes.run_files import require_new
from ls3_recipes.run_folder import RunFolder
from ls3_recipes.run_settings import RunSettings
from ls3_torchrl.options.planner import PlannerOptions


def trained_settings(settings: EvaluateSettings) -> RunSettings:
    """The settings of the run, with the changes that are asked for.

    Raises:
        ValueError: for changes of a planner that the run's algorithm does not have.
    """
    trained, changes = settings_of_run(settings.run), settings.planner_changes
    if not changes:
        return trained
    if not isinstance(trained, LS3Settings):
        named = ", ".join(f"planner.{name}={'null' if value is None else value}" for name, value in changes.items())
        raise ValueError(f"{settings.run} is a run of {trained.algorithm}, which has no planner: leave out {named}.")
    with errors_of("planner", defaults(PlannerOptions)):
        return replace(trained, planner=replace(trained.planner, **changes))


def _require_agent(file: Path, run: Path) -> None:
    """Raise ``FileNotFoundError`` for an agent that is not there, with those that are."""
    if file.is_file():
        return
    there = [str(path.relative_to(run)) for path in sorted(run.glob("checkpoints/agent_*.pt"))]
    unfinished = not (run / "summary.json").is_file()
    raise FileNotFoundError(
        f"{file} is missing."
        + (f" The newest agent of the run is agent={there[-1]}." if there else " The run has saved no agent yet.")
        + (f" It is not finished: ls3 train resume={run} goes on with it." if unfinished else "")
    )


def evaluate(settings: EvaluateSettings) -> dict:
    """Run episodes of a trained policy.

    Returns:
        What is written to ``summary.json``.

    Raises:
        FileNotFoundError: when ``run`` is no run's folder.
        FileExistsError: when the output folder exists.
    """
    device, trained = choose_device(settings.device), trained_settings(settings)
    require_new(settings.output)
    torch.manual_seed(settings.seed)
    env = make_env(trained.task, settings.episodes, settings.seed, device)
    if settings.planner_changes:
        trained.require_horizon(env.base_env.horizon)
    algorithm = ALGORITHMS[trained.algorithm].load()(trained, env, device)
    algorithm.prepare(env)
    file = Path(settings.run) / settings.agent
    _require_agent(file, Path(settings.run))
    algorithm.restore(file)
    folder = RunFolder.make(settings.output, as_dict(settings) | {"planner": as_dict(trained).get("planner", {})})
    episodes = run_episodes(env, algorithm.policy, what="Evaluation")
    summary: dict[str, Any] = {
        "algorithm": algorithm.name,
        "task": trained.task.name,
        "preset": trained.preset,
        "seed": settings.seed,
        "evaluation": summarise([episode_figures(episodes)]),
        "hardware": hardware(device),
        "agent": str(file),
        "minutes": folder.minutes,
    }
    folder.write_json("summary.json", summary)
    films = ("evaluation.gif", "evaluation.mp4")
    failed = draw({name: partial(save_film, folder.path / name, episodes) for name in films})
    summary |= {"minutes": folder.minutes} | ({"failed_pictures": failed} if failed else {})
    folder.write_json("summary.json", summary)
    folder.close()
    print_summary(summary, folder.path)
    return summary
