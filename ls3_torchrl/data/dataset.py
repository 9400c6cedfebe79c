"""Save, load and check collected episodes."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase

from ls3_torchrl._checks import require_finite, require_keys
from ls3_torchrl.data.tags import Tag

FORMAT = "ls3_torchrl.episodes"
VERSION = 1
_DESCRIPTION = "episodes.json"


def check_episodes(episodes: TensorDictBase, *, name: str = "episodes") -> None:
    """Check collected episodes before hours are spent on them.

    Args:
        episodes: ``[N, T]`` with the standard keys.
        name: how to call them in messages.

    Raises:
        KeyError: when a key is missing.
        ValueError: for a wrong batch shape, wrong image shape, or data that are not finite.
        TypeError: when the images are not uint8.
    """
    needed = ("pixels", "action", *(("next", k) for k in ("pixels", "reward", "constraint", "success")))
    require_keys(episodes, needed, name)
    if episodes.ndim != 2:
        raise ValueError(f"{name} must have batch size [N, T], got {list(episodes.shape)}.")
    for key in ("pixels", ("next", "pixels")):
        images = episodes.get(key)
        if images.dtype != torch.uint8:
            raise TypeError(f"{name}: {key} must be uint8 in 0..255, got {images.dtype}.")
        if images.ndim != 5 or images.shape[-2:] != (64, 64):
            raise ValueError(f"{name}: {key} must have shape [N, T, C, 64, 64], got {list(images.shape)}.")
    require_finite(episodes["action"], f"{name}: action")
    require_finite(episodes["next", "reward"], f"{name}: reward")


def save_episodes(datasets: dict[Tag, TensorDictBase], folder: str | Path, *, task: str, seed: int) -> Path:
    """Write episodes by tag as memory-mapped tensordicts, with a description beside them.

    Args:
        datasets: episodes ``[N, T]`` by tag.
        folder: must not exist yet.
        task: name of the domain.
        seed: seed of the collection.

    Returns:
        The folder.

    Raises:
        FileExistsError: when the folder exists.
    """
    folder = Path(folder)
    if folder.exists():
        raise FileExistsError(f"{folder} exists already. Choose another folder, or remove it first.")
    for tag, episodes in datasets.items():
        check_episodes(episodes, name=tag.name.lower())
    for tag, episodes in datasets.items():
        episodes.contiguous().memmap(str(folder / tag.name.lower()))
    description = {
        "format": FORMAT,
        "version": VERSION,
        "task": task,
        "seed": seed,
        "episodes": {tag.name.lower(): list(episodes.shape) for tag, episodes in datasets.items()},
    }
    (folder / _DESCRIPTION).write_text(json.dumps(description, indent=2) + "\n")
    return folder


def load_episodes(folder: str | Path, *, task: str | None = None) -> dict[Tag, TensorDictBase]:
    """Read episodes written by :func:`save_episodes`.

    Args:
        folder: where they lie.
        task: the domain that they must be of, if any.

    Returns:
        Episodes ``[N, T]`` by tag, memory-mapped.

    Raises:
        FileNotFoundError: when the folder has no description.
        ValueError: for another format, version or domain.
    """
    folder = Path(folder)
    path = folder / _DESCRIPTION
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no episodes: {_DESCRIPTION} is missing. Make some with collect.py.")
    description = json.loads(path.read_text())
    received = (description.get("format"), description.get("version"))
    if received != (FORMAT, VERSION):
        raise ValueError(f"{folder} holds {received}, but this version reads {(FORMAT, VERSION)}. Collect again.")
    if task is not None and description["task"] != task:
        raise ValueError(f"{folder} holds episodes of {description['task']!r}, but {task!r} is wanted.")
    datasets: dict[Tag, TensorDictBase] = {}
    for name in description["episodes"]:
        datasets[Tag.parse(name)] = TensorDict.load_memmap(str(folder / name))
        check_episodes(datasets[Tag.parse(name)], name=name)
    return datasets
