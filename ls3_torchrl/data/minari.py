"""Episodes from Minari, Farama's format of offline data."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase

from ls3_torchrl.data.keys import EpisodeKeys, as_tuple
from ls3_torchrl.data.packages import require_package
from ls3_torchrl.data.pixels import Channels, Fit, pixels_from_images, require_image_settings
from ls3_torchrl.data.recordings import (
    Recording,
    Source,
    Sources,
    TagSource,
    chosen,
    episodes_by_tag,
    make_episode,
    read_source,
)
from ls3_torchrl.data.tags import Tag

#: What an episode of Minari holds beside its observations and infos, for each step.
_OF_STEPS = ("actions", "rewards", "terminations", "truncations")


def load_minari(
    dataset: Any,
    *,
    observation: Source | None = None,
    action: Source | None = None,
    reward: Source | None = None,
    constraint: Source | None = None,
    success: Source | None = None,
    tag: TagSource | None = None,
    extra: Mapping[NestedKey, Source] | None = None,
    episodes: Iterable[int] | None = None,
    size: int | tuple[int, int] | None = 64,
    fit: Fit = "squash",
    channels: Channels = "last",
    keys: EpisodeKeys | None = None,
) -> dict[Tag, TensorDictBase]:
    """Episodes of a Minari dataset by tag, as ``buffer.add`` and :func:`~ls3_torchrl.data.save_episodes` take them.

    What :func:`~ls3_torchrl.data.save_minari` has written needs no further argument. Of other datasets, where the
    labels come from must be told: each source is

    - the name of an entry, such as ``("infos", "cost")``, ``("observations", "camera")`` or ``"terminations"``; its
      last part is enough where no other entry has it,
    - a function of the episode, a ``minari.EpisodeData``, such as ``lambda episode: episode.infos["cost"] > 0``,
    - for labels, ``False`` (or ``True``) for all steps.

    Values are one for each of the T steps, or for each of the T + 1 states, as ``infos`` usually are; of states, a step
    gets the one that it leads to.

    Args:
        dataset: a ``minari.MinariDataset``, the name of a local one, such as ``"mine/robot-v0"``, or the path of its
            folder. Nothing is downloaded: ``minari.download_dataset(name)`` does that.
        observation: source of the observation ``[T + 1, ...]``. When ``None`` the only one, the one that is called as
            in ``keys``, or the only image.
        action: source of the actions ``[T, A]``; the recorded ones when ``None``.
        reward: source of the rewards; the recorded ones, as they are, when ``None``. LS³ takes −1 outside of the goal
            and 0 in it.
        constraint: source of whether a step leads to a violation, bools or 0 and 1; the entry of ``infos`` of that
            name when ``None``.
        success: source of whether it leads into the goal set, alike.
        tag: the tag of all episodes, or a function of an episode. When ``None`` the one that was saved; without one,
            an episode with a violation is ``constraint``, another with a success ``success``, and all others ``rand``.
        extra: sources of further entries by their keys; of states, ``("next", key)`` is set as well.
        episodes: numbers of those to read; all when ``None``.
        size: height and width of images, one number where they are alike; ``None`` leaves observations as recorded.
            Observations with less than two dimensions are never touched.
        fit: how images get that size: see :func:`~ls3_torchrl.data.pixels_from_images`.
        channels: where images have them.
        keys: under which keys the entries go; the defaults of :class:`~ls3_torchrl.data.EpisodeKeys` when ``None``.

    Returns:
        Lazy stacks of episodes ``[N, T_i]`` by tag. Where the dataset says that the last step alone ends an episode,
        ``terminated``, ``truncated`` and ``done`` lie under ``next``.

    Raises:
        ModuleNotFoundError: when Minari, or what it needs for the dataset, is not installed.
        FileNotFoundError: when there is no such dataset.
        KeyError: for an entry that is not there, or a source that must be given.
        ValueError: for actions that are not continuous, images that cannot be understood, labels other than 0 and 1,
            and all that :func:`~ls3_torchrl.data.check_episodes` refuses; messages name the episode.

    Warns:
        DataWarning: for recorded rewards that are not −1 outside of the goal and 0 in it.

    Source:
        Minari 0.5, https://minari.farama.org.

    Example:
        >>> import tempfile
        >>> from unittest.mock import patch
        >>> from ls3_torchrl.data import episode_from_arrays, save_minari
        >>> pixels, reached = np.zeros((10, 3, 64, 64), dtype=np.uint8), np.arange(9) == 8
        >>> episode = episode_from_arrays(pixels, np.zeros((9, 2)), reached - 1.0, np.zeros(9), reached)
        >>> with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, MINARI_DATASETS_PATH=folder):
        ...     saved = save_minari({Tag.SUCCESS: [episode]}, "mine/robot-v0")
        ...     load_minari("mine/robot-v0")[Tag.SUCCESS].batch_size
        torch.Size([1, 9])
    """
    require_image_settings(64 if size is None else size, fit, channels)
    keys = keys or EpisodeKeys()
    sources = Sources(action, reward, constraint, success, tag, extra or {})
    found = _dataset(dataset)
    who = f"Minari's {found.id}"

    def read() -> Iterator[tuple[Tag, TensorDictBase]]:
        for index in chosen(episodes, (int(i) for i in found.episode_indices), who):
            data = next(iter(found.iterate_episodes([index])))
            (metadata,) = found.storage.get_episode_metadata([index])
            recording = _recording(data, metadata, f"Episode {index} of {who}")
            if sources.action is None:
                _require_continuous(found.action_space, who)
            observations = _observations(recording, observation, keys, size, fit, channels)
            made, row = make_episode(recording, observations, sources, keys)
            _set_ends(row, data)
            yield made, row

    return episodes_by_tag(read(), sources, keys, who)


def _dataset(dataset: Any) -> Any:
    """A Minari dataset of itself, its name or its folder."""
    minari = require_package("minari", "load_minari")
    if isinstance(dataset, minari.MinariDataset):
        return dataset
    if isinstance(dataset, os.PathLike):
        folder = Path(dataset)
        data = folder / "data" if (folder / "data").is_dir() else folder
        if not (data / "metadata.json").is_file():
            raise FileNotFoundError(f"{folder} holds no Minari dataset: {data / 'metadata.json'} is missing.")
        return minari.MinariDataset(data)
    if not isinstance(dataset, str):
        raise TypeError(
            f"dataset must be a Minari dataset, its name or the Path of its folder, got {type(dataset).__name__}. "
            "Give minari.load_dataset(name)."
        )
    return minari.load_dataset(dataset)


def _recording(data: Any, metadata: Mapping[str, Any], name: str) -> Recording:
    entries = dict(_leaves(data.observations, ("observations",)))
    entries |= dict(_leaves(data.infos or {}, ("infos",)))
    for what in _OF_STEPS:
        entries |= dict(_leaves(getattr(data, what), (what,)))
    defaults: dict[str, tuple[str, ...]] = {"action": ("actions",), "reward": ("rewards",)}
    defaults |= {what: ("infos", what) for what in ("constraint", "success") if ("infos", what) in entries}
    tag = metadata.get("tag")
    return Recording(data, name, len(data.rewards), entries, defaults, None if tag is None else str(tag))


def _leaves(values: Any, name: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Arrays by their names; of tuples, by their numbers."""
    if isinstance(values, Mapping):
        for key, value in values.items():
            yield from _leaves(value, (*name, str(key)))
    elif isinstance(values, tuple):
        for number, value in enumerate(values):
            yield from _leaves(value, (*name, str(number)))
    else:
        yield name, values


def _require_continuous(space: Any, who: str) -> None:
    spaces = require_package("gymnasium.spaces", "load_minari", "gymnasium")
    if not isinstance(space, spaces.Box):
        raise ValueError(
            f"{who} has actions of {space}, but LS³ plans continuous ones, [T, A] of floats within bounds. Give "
            "action= a function that makes them, such as that of the entry of a Dict which the robot carries out."
        )


def _observations(
    recording: Recording,
    source: Source | None,
    keys: EpisodeKeys,
    size: int | tuple[int, int] | None,
    fit: Fit,
    channels: Channels,
) -> Any:
    """Observations ``[T + 1, ...]``, images as the encoder takes them."""
    values = read_source(recording, _name_of(recording, keys) if source is None else source, "observation")
    if len(values) != recording.steps + 1:
        raise ValueError(
            f"{recording.name}: its {recording.steps} steps need {recording.steps + 1} observations, got {len(values)}."
            " The one after the last step is needed, too."
        )
    if size is None or values.ndim < 3:
        return values
    if values.ndim == 3:  # grey
        values, channels = values[..., None], "last"
    try:
        return pixels_from_images(values, size=size, fit=fit, channels=channels)
    except (TypeError, ValueError) as error:
        remedy = "Name another entry with observation=, or give a function; size=None takes observations as they are."
        raise type(error)(f"{recording.name}: {error} {remedy}") from error


def _name_of(recording: Recording, keys: EpisodeKeys) -> tuple[str, ...]:
    """The entry that must be meant."""
    there = {name: np.asarray(value) for name, value in recording.entries.items() if name[0] == "observations"}
    wanted = ("observations", *as_tuple(keys.observation))
    if wanted in there:
        return wanted
    images = [name for name, value in there.items() if value.dtype == np.uint8 and value.ndim in (3, 4)]
    candidates = list(there) if len(there) == 1 else images
    if len(candidates) != 1:
        names = ", ".join(map(repr, there))
        raise KeyError(
            f"{recording.name} has {len(images)} images among its {len(there)} observations. Say with observation= "
            f"which one is meant: {names}."
        )
    return candidates[0]


def _set_ends(episode: TensorDictBase, data: Any) -> None:
    """Mark how an episode ends, where its last step alone does."""
    flags = {
        "terminated": torch.tensor(np.asarray(data.terminations, dtype=bool)).reshape(-1, 1),
        "truncated": torch.tensor(np.asarray(data.truncations, dtype=bool)).reshape(-1, 1),
    }
    flags["done"] = flags["terminated"] | flags["truncated"]
    if bool(flags["done"][-1]) and not flags["done"][:-1].any():
        for key, value in flags.items():
            episode["next", key] = value
