"""Episodes of what a run of any algorithm has trained."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.envs import TransformedEnv

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
from ls3_torchrl import LS3Agent
from ls3_torchrl.options.planner import PlannerOptions
from ls3_torchrl.planners import SafeSetFilter, describe_filter


def trained_settings(settings: EvaluateSettings) -> RunSettings:
    """The settings of the run, with the changes that are asked for.

    Raises:
        ValueError: for changes of a planner that the run's algorithm does not have.
    """
    trained = settings_of_run(settings.run)
    return trained if settings.filter else _changed(trained, settings.run, settings.planner_changes)


def _changed(trained: RunSettings, run: str, changes: dict[str, Any]) -> RunSettings:
    if not changes:
        return trained
    if not isinstance(trained, LS3Settings):
        named = ", ".join(f"planner.{name}={'null' if value is None else value}" for name, value in changes.items())
        raise ValueError(f"{run} is a run of {trained.algorithm}, which has no planner: leave out {named}.")
    with errors_of("planner", defaults(PlannerOptions)):
        return replace(trained, planner=replace(trained.planner, **changes))


def filter_settings(settings: EvaluateSettings, task: str) -> LS3Settings | None:
    """The settings of the run that filters, with the changes that are asked for.

    Raises:
        ValueError: for a run of another algorithm, or on another task.
    """
    if settings.filter is None:
        return None
    trained = settings_of_run(settings.filter)
    if not isinstance(trained, LS3Settings):
        raise ValueError(
            f"filter must be the folder of a run of ls3; {settings.filter} is one of {trained.algorithm}, which has no "
            "planner."
        )
    if trained.task.name != task:
        raise ValueError(
            f"filter must be a run on {task}, as {settings.run} is; {settings.filter} is one on {trained.task.name}."
        )
    changed = _changed(trained, settings.filter, settings.planner_changes)
    assert isinstance(changed, LS3Settings)
    return changed


def filtered(
    policy: TensorDictModuleBase, run: Path, planner: PlannerOptions, env: TransformedEnv, device: torch.device
) -> SafeSetFilter:
    """The policy behind a filter of the agent of ``run``; the environment carries the filter's plans on."""
    require_agent(run / "agent.pt", run)
    agent = LS3Agent.load(run / "agent.pt").to(device)
    out = SafeSetFilter(policy, agent.planner(env.action_spec, plan_key="filter_plan", **as_dict(planner)))
    env.append_transform(out.make_tensordict_primer())
    return out


def require_agent(file: Path, run: Path) -> None:
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


def _policy(
    settings: EvaluateSettings, trained: RunSettings, env: TransformedEnv, device: torch.device
) -> tuple[TensorDictModuleBase, str, Path | None]:
    """What acts, its name, and the file that it comes from."""
    if settings.policy == "random":
        return TensorDictModule(env.action_spec.rand, [], ["action"]), "random", None
    algorithm = ALGORITHMS[trained.algorithm].load()(trained, env, device)
    algorithm.prepare(env)
    file = Path(settings.run) / settings.agent
    require_agent(file, Path(settings.run))
    algorithm.restore(file)
    return algorithm.policy, algorithm.name, file


def evaluate(settings: EvaluateSettings) -> dict:
    """Run episodes of a trained policy.

    Returns:
        What is written to ``summary.json``.

    Raises:
        FileNotFoundError: when ``run`` is no run's folder.
        FileExistsError: when the output folder exists.
    """
    device, trained = choose_device(settings.device), trained_settings(settings)
    filtering = filter_settings(settings, trained.task.name)
    require_new(settings.output)
    torch.manual_seed(settings.seed)
    env = make_env(trained.task, settings.episodes, settings.seed, device)
    if settings.planner_changes:
        (filtering or trained).require_horizon(env.base_env.horizon)
    policy, who, file = _policy(settings, trained, env, device)
    if filtering is not None and settings.filter is not None:
        policy = filtered(policy, Path(settings.filter), filtering.planner, env, device)
    plans = as_dict(filtering or trained).get("planner", {})
    folder = RunFolder.make(settings.output, as_dict(settings) | {"planner": plans})
    episodes = run_episodes(env, policy, what="Evaluation")
    summary: dict[str, Any] = {
        "algorithm": who,
        "task": trained.task.name,
        "preset": trained.preset,
        "seed": settings.seed,
        "evaluation": summarise([episode_figures(episodes)]),
        "hardware": hardware(device),
        "agent": None if file is None else str(file),
        "minutes": folder.minutes,
    }
    if filtering is not None:
        rates = {name: value.item() for name, value in describe_filter(episodes).items()}
        summary |= {"filtered_by": settings.filter, "filter": rates}
    folder.write_json("summary.json", summary)
    films = ("evaluation.gif", "evaluation.mp4")
    failed = draw({name: partial(save_film, folder.path / name, episodes) for name in films})
    summary |= {"minutes": folder.minutes} | ({"failed_pictures": failed} if failed else {})
    folder.write_json("summary.json", summary)
    folder.close()
    print_summary(summary, folder.path)
    return summary
