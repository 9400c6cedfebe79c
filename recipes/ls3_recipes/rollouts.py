"""How the agent of every update does: the curves of Figure 1."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.configuration import settings_of_run
from ls3_recipes.console import console
from ls3_recipes.device import choose_device
from ls3_recipes.figures import episode_figures
from ls3_recipes.rollout import make_env, run_episodes
from ls3_recipes.rollout_files import agents_left, file_of, number_of
from ls3_recipes.seeding import seeds
from ls3_torchrl.files import save_json_atomically


def roll_out(run: str | Path, episodes: int) -> None:
    """Have every agent that a run has kept act in the same episodes, without exploring or learning.

    An agent learns once for all the episodes of a round, so that there is one for each round. Those that have acted are
    left out, so that what is cut off goes on.

    Args:
        run: a run's folder; ``rollouts/`` in it gets a file for each agent.
        episodes: side by side, of each agent.

    Raises:
        FileNotFoundError: for a folder that holds no run, or none of its agents any more.
    """
    settings, left = settings_of_run(run), list(agents_left(run, episodes))
    if not left:
        if not any((Path(run) / "rollouts").glob("agent_*.json")):
            raise FileNotFoundError(f"{run} has no agents in checkpoints/ any more: there is nothing to roll out.")
        return
    device, seed = choose_device(settings.device), seeds(settings.seed)["rollouts"]
    env = make_env(settings.task, episodes, seed, device)
    algorithm = ALGORITHMS[settings.algorithm].load()(settings, env, device)
    for file in left:
        update = number_of(file)
        env = make_env(settings.task, episodes, seed, device)
        algorithm.prepare(env)
        algorithm.restore(file)
        torch.manual_seed(seed)
        done = run_episodes(env, algorithm.policy, what=f"Agent of update {update}")
        figures: dict[str, Any] = {name: value.tolist() for name, value in episode_figures(done).items()}
        online = update * settings.online.episodes_per_update
        save_json_atomically({"update": update, "online_episodes": online, **figures}, file_of(run, file))
        success, violation = (sum(figures[name]) / len(figures[name]) for name in ("success", "violation"))
        console.print(f"  update {update}: success {success:.0%}, violation {violation:.0%}")
