"""``ls3 evaluate``: episodes of what a run of any algorithm has trained."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, make_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

import torch

import ls3_envs  # noqa: F401  (before TorchRL, which imports MuJoCo: whatever MUJOCO_GL says)
from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.algorithms.ls3 import LS3Settings, PlannerSettings
from ls3_recipes.configuration import register, run_command, settings_of_run
from ls3_recipes.console import print_summary
from ls3_recipes.device import choose_device, hardware
from ls3_recipes.figures import episode_figures, summarise
from ls3_recipes.options import as_dict, defaults, errors_of
from ls3_recipes.plots.run import save_video
from ls3_recipes.plots.style import draw
from ls3_recipes.rollout import make_env, run_episodes
from ls3_recipes.run_files import require_new
from ls3_recipes.run_folder import RunFolder
from ls3_recipes.run_settings import RunSettings, require_path, require_seed
from ls3_torchrl._checks import require_at_least

HELP = """
Evaluate a trained agent: a table, summary.json and a video.

  ls3 evaluate run=RUN_FOLDER [agent=FILE] [episodes=N] [seed=N] [planner.KEY=VALUE ...]

Examples
  ls3 evaluate run=runs/navigation episodes=100
  ls3 evaluate run=runs/navigation agent=checkpoints/agent_000.pt
  ls3 evaluate run=runs/navigation planner.num_candidates=1000
"""

#: Each planner setting in place of the run's, which ``None`` keeps.
PlannerChanges = make_dataclass(
    "PlannerChanges",
    [(name, hint | None, field(default=None)) for name, hint in get_type_hints(PlannerSettings).items()],
    frozen=True,
)


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings:
    """What is evaluated, and how.

    Args:
        run: folder of a finished run.
        agent: file in it.
        episodes: side by side.
        seed: of the environments.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        output: a folder that does not exist yet.
        planner: settings in place of the run's; for LS³ alone.
    """

    run: str
    agent: str = "agent.pt"
    episodes: int = 20
    seed: int = 12345
    device: str = "auto"
    output: str
    planner: PlannerChanges = field(default_factory=PlannerChanges)  # type: ignore[valid-type]

    def __post_init__(self) -> None:
        """Refuse an evaluation of nothing."""
        require_at_least(self.episodes, 1, "episodes")
        require_seed(self.seed)
        for name in ("run", "agent", "output"):
            require_path(getattr(self, name), name)

    @property
    def planner_changes(self) -> dict[str, Any]:
        """The planner's settings that differ from the run's."""
        return {name: value for name, value in as_dict(self.planner).items() if value is not None}


register("evaluate", EvaluateSettings)


def trained_settings(settings: EvaluateSettings) -> RunSettings:
    """The settings of the run, with the changes that are asked for.

    Raises:
        ValueError: for changes of a planner that the run's algorithm does not have.
    """
    trained, changes = settings_of_run(settings.run), settings.planner_changes
    if not changes:
        return trained
    if not isinstance(trained, LS3Settings):
        named = ", ".join(f"planner.{name}={value}" for name, value in changes.items())
        raise ValueError(f"{settings.run} is a run of {trained.algorithm}, which has no planner: leave out {named}.")
    with errors_of("planner", defaults(PlannerSettings)):
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
    algorithm = ALGORITHMS[trained.algorithm](trained, env, device)
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
    failed = draw({"evaluation.gif": lambda: save_video(folder.path / "evaluation.gif", episodes)})
    summary |= {"minutes": folder.minutes} | ({"failed_pictures": failed} if failed else {})
    folder.write_json("summary.json", summary)
    folder.close()
    print_summary(summary, folder.path)
    return summary


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    arguments = sys.argv[1:] if arguments is None else arguments
    run_command("evaluate", EvaluateSettings, evaluate, arguments, help_text=HELP)
