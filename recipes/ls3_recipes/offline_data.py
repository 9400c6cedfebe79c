"""Where a run's offline data come from: a folder that the settings name, or the task's demonstrators."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torchrl.data import TensorSpec

from ls3_recipes.console import console
from ls3_recipes.rollout import collect_demonstrations
from ls3_recipes.run_settings import RunSettings, TaskSettings
from ls3_recipes.seeding import seeds
from ls3_torchrl.data import Tag, TaggedReplayBuffer, check_datasets, load_episodes, save_episodes

Offline = dict[Tag, TensorDictBase]


def given_data(folder: str, task: TaskSettings, action_spec: TensorSpec, needs: Iterable[Tag], who: str) -> Offline:
    """Episodes that were collected before, by tag.

    Args:
        folder: made by ``ls3 collect`` or :func:`~ls3_torchrl.data.save_episodes`.
        task: that they must be of.
        action_spec: of its environments.
        needs: tags that must be among them.
        who: needs them.

    Raises:
        FileNotFoundError: for a folder without episodes.
        ValueError: for episodes that are damaged, of another task, without a tag that is needed, or with actions and
            rewards that do not fit the task.
    """
    offline = load_episodes(folder, task=task.name)
    for tag in needs:
        if tag not in offline:
            raise ValueError(f"{folder} has no {tag.name.lower()} episodes, which {who} needs. Collect them first.")
    try:
        check_datasets(offline, action_spec=action_spec)
    except (ValueError, TypeError, KeyError) as error:
        raise type(error)(f"data={folder}: {error}") from error
    return offline


def collected_data(folder: Path, task: TaskSettings, seed: int, run_seed: int) -> Offline:
    """The task's demonstrations, collected into a folder unless they lie there.

    Args:
        folder: whole or not there.
        task: to collect for.
        seed: of the demonstrators.
        run_seed: what the folder says of its seed.
    """
    if not folder.exists():
        with torch.random.fork_rng():  # what is learnt does not depend on whether the data were there already
            collected = collect_demonstrations(task, seed)
        save_episodes(collected, folder, task=task.name, seed=run_seed)
    return load_episodes(folder)  # from the disk: there may be more than memory


def collect_for_run(settings: RunSettings) -> None:
    """The demonstrations that a run would collect, into its ``output``, for runs that share them."""
    assert settings.output is not None
    task, seed = settings.task, settings.seed
    collected_data(Path(settings.output), task, seeds(seed)["demonstrations"], seed)


def tell_of_eviction(buffer: TaggedReplayBuffer, online: int) -> None:
    """Say how much of the online episodes a buffer will forget.

    Args:
        buffer: that holds the offline data.
        online: transitions to come.
    """
    room = buffer.capacity - len(buffer)
    if online > room:
        console.print(
            f"The replay buffer holds all {len(buffer)} offline transitions and the newest {room} of {online} online "
            f"ones: buffer.capacity={buffer.capacity}."
        )
