"""Thresholds of a trained agent that miss few violations, tested on violations that they were not found on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rich.table import Table
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

import ls3_envs
from ls3_recipes.algorithms.settings.ls3 import LS3Settings
from ls3_recipes.command_settings import CalibrateSettings
from ls3_recipes.configuration import settings_of_run
from ls3_recipes.console import console
from ls3_recipes.device import choose_device, hardware
from ls3_recipes.evaluation import require_agent
from ls3_recipes.options import as_dict
from ls3_recipes.plots.calibration import plot_calibration
from ls3_recipes.plots.style import draw
from ls3_recipes.rollout import whole_episodes
from ls3_recipes.run_files import require_new
from ls3_recipes.run_folder import RunFolder
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, load_episodes, split_episodes, steps_into_violation
from ls3_torchrl.planners import LS3Planner, calibrate, foresee


def calibrate_run(settings: CalibrateSettings) -> dict[str, Any]:
    """Calibrate an agent on one half of fresh violating episodes, and count what is missed in the other.

    Returns:
        What is written to ``summary.json``: for every α the thresholds, the shares of violations missed by each, and
        the share of steps before a violation that δ_C takes for one; or, under ``not_found``, why there are none.

    Raises:
        FileNotFoundError: when ``run`` is no run's folder, or has no such agent.
        FileExistsError: when the output folder exists.
        ValueError: for a run of another algorithm, data of another task, or when no α has thresholds.
    """
    device, trained = choose_device(settings.device), settings_of_run(settings.run)
    if not isinstance(trained, LS3Settings):
        raise ValueError(f"{settings.run} is a run of {trained.algorithm}, which has no planner to calibrate.")
    require_new(settings.output)
    require_agent(Path(settings.run) / settings.agent, Path(settings.run))
    planner = LS3Agent.load(Path(settings.run) / settings.agent).to(device).planner(**as_dict(trained.planner))
    torch.manual_seed(settings.seed)
    episodes = split_episodes(_violating(settings, trained.task.name))
    episodes = [episodes[i] for i in torch.randperm(len(episodes)).tolist()]
    half = len(episodes) // 2
    known, new = steps_into_violation(episodes[:half]), steps_into_violation(episodes[half:])
    test = foresee(planner, new.to(device)).cpu()
    calm = _foresee(planner, torch.cat([_before_violation(episode) for episode in episodes[half:]]), device)
    levels, not_found = _levels(planner, known.to(device), settings.alpha, test, calm)
    folder = RunFolder.make(settings.output, as_dict(settings))
    summary: dict[str, Any] = {
        "task": trained.task.name,
        "preset": trained.preset,
        "agent": str(Path(settings.run) / settings.agent),
        "seed": settings.seed,
        "found_on": len(known),
        "tested_on": len(new),
        "levels": levels,
        "not_found": not_found,
        "hardware": hardware(device),
    }
    failed = draw({"calibration.png": lambda: plot_calibration(folder.path / "calibration.png", levels, test, calm)})
    folder.write_json("summary.json", summary | ({"failed_pictures": failed} if failed else {}))
    folder.close()
    _print(summary, folder.path)
    return summary


def _violating(settings: CalibrateSettings, task: str) -> TensorDictBase | list[TensorDictBase]:
    """Episodes, most of which violate, that the agent has not learnt from."""
    if settings.data is not None:
        given = load_episodes(settings.data, task=task)
        if Tag.CONSTRAINT not in given:
            raise ValueError(f"{settings.data} has no violating episodes (tag constraint).")
        return given[Tag.CONSTRAINT]
    return whole_episodes(ls3_envs.collect_offline(task, "constraint", episodes=settings.episodes, seed=settings.seed))


def _before_violation(episode: TensorDictBase) -> TensorDictBase:
    """The steps before the one that leads into a violation."""
    violates = episode["next", "constraint"].flatten().nonzero()
    return episode[: int(violates[0]) if len(violates) else len(episode)].select("pixels", "action")


def _foresee(planner: LS3Planner, steps: TensorDictBase, device: torch.device) -> TensorDict:
    return torch.cat([foresee(planner, part.to(device)).cpu() for part in steps.split(512)])


def _levels(
    planner: LS3Planner, known: TensorDictBase, alphas: Sequence[float], test: TensorDictBase, calm: TensorDictBase
) -> tuple[list[dict[str, float]], dict[str, str]]:
    """The thresholds for each α that has any, and why the others have none."""
    levels, not_found = [], {}
    for alpha in alphas:
        try:
            levels.append(_level(planner, known, alpha, test, calm))
        except ValueError as error:
            not_found[f"{alpha:g}"] = str(error)
    if not levels:
        raise ValueError(" ".join(not_found.values()))
    return levels, not_found


def _level(
    planner: LS3Planner, known: TensorDictBase, alpha: float, test: TensorDictBase, calm: TensorDictBase
) -> dict[str, float]:
    """The thresholds for one α, and what they miss."""
    found = calibrate(planner, known, alpha)
    return {
        "alpha": alpha,
        "constraint_threshold": found.constraint_threshold,
        "safe_set_threshold": found.safe_set_threshold,
        "missed_by_constraint": _share(test["constraint_prob"] <= found.constraint_threshold),
        "missed_by_safe_set": _share(test["safe_set_prob"] >= found.safe_set_threshold),
        "false_alarms": _share(calm["constraint_prob"] > found.constraint_threshold),
    }


def _share(flags: Tensor) -> float:
    return round(float(flags.float().mean()), 4)


def _print(summary: dict[str, Any], folder: Path) -> None:
    table = Table(title="{agent}: found on {found_on} violations, tested on {tested_on}".format(**summary))
    for column in ("alpha", "δ_C", "missed by it", "false alarms", "δ_S", "missed by it"):
        table.add_column(column, justify="right")
    for level in summary["levels"]:
        table.add_row(
            f"{level['alpha']:g}",
            f"{level['constraint_threshold']:.3g}",
            f"{level['missed_by_constraint']:.1%}",
            f"{level['false_alarms']:.1%}",
            f"{level['safe_set_threshold']:.3g}",
            f"{level['missed_by_safe_set']:.1%}",
        )
    console.print(table)
    for alpha, reason in summary["not_found"].items():
        console.print(f"alpha={alpha}: {reason}", markup=False)
    console.print(f"Everything is in {folder}", markup=False, soft_wrap=True)
