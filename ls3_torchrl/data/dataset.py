"""Save, load and check collected episodes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import LazyStackedTensorDict, NestedKey, TensorDict, TensorDictBase, is_leaf_nontensor
from torch import Tensor

from ls3_torchrl._checks import require_keys
from ls3_torchrl.data.arrays import Entry, read_array, require_checksum, with_checksum, write_array
from ls3_torchrl.data.conform import conform
from ls3_torchrl.data.episodes import split_episodes
from ls3_torchrl.data.keys import EpisodeKeys, as_tuple
from ls3_torchrl.data.memory_maps import read_memory_maps
from ls3_torchrl.data.tags import Tag
from ls3_torchrl.files import load_json, new_folder, save_json_atomically

FORMAT = "ls3_torchrl.episodes"
VERSION = 3
_DESCRIPTION = "episodes.json"
# Branches of a stored tensordict: entries of states lie T + 1 times for an episode, entries of steps T times.
_STATES, _STEPS = "states", "steps"


def check_episodes(
    episodes: TensorDictBase | list[TensorDictBase], *, keys: EpisodeKeys | None = None, name: str = "episodes"
) -> None:
    """Check collected episodes before hours are spent on them.

    Args:
        episodes: ``[N, T]``, or a list or lazy stack of episodes ``[T_i]`` of different lengths.
        keys: where they keep their entries; the defaults of :class:`~ls3_torchrl.data.EpisodeKeys` when ``None``.
            Observations under ``"pixels"`` must be images as :class:`~ls3_torchrl.modules.PixelEncoder` takes them;
            under another key they may be of any shape and type.
        name: how to call them in messages.

    Raises:
        KeyError: when a key is missing.
        ValueError: for a wrong batch shape, wrong image shape, observations that differ in shape or type from those
            after them, data that are not finite, or rows that hold padding or more than one episode.
        TypeError: when the images are not uint8.

    It also raises whatever the buffer refuses an episode with.

    Warns:
        DataWarning: naming what the buffer would convert.

    Example:
        >>> from ls3_torchrl.data import episode_from_arrays
        >>> keys = EpisodeKeys(observation="state")
        >>> no = torch.zeros(9)
        >>> episode = episode_from_arrays(torch.zeros(10, 4), torch.zeros(9, 2), -torch.ones(9), no, no, keys=keys)
        >>> check_episodes([episode], keys=keys)
    """
    checked_rows(episodes, keys or EpisodeKeys(), name)


def checked_rows(episodes: TensorDictBase | list[TensorDictBase], keys: EpisodeKeys, name: str) -> list[TensorDictBase]:
    """Episodes ``[T_i]`` in the form that is kept."""
    rows = _rows(episodes, name)
    for number, row in enumerate(rows):
        parts = split_episodes(row)
        if len(parts) != 1 or len(parts[0]) != len(row):
            raise ValueError(
                f"{name}: row {number} of {len(row)} steps holds {len(parts)} episodes of "
                f"{[len(part) for part in parts]} steps. Give split_episodes(data), one episode for each row."
            )
        require_keys(row, keys.required, name)
        if keys.observation == "pixels":
            for key in (keys.observation, keys.next_observation):
                _check_images(row.get(key), key, name)
    return conform(rows, keys, who=name)


def _check_images(value: Tensor, key: NestedKey, name: str) -> None:
    if value.ndim != 4 or value.shape[-2:] != (64, 64):
        raise ValueError(
            f"{name}: {key} must have shape [N, T, C, 64, 64], got [N, {', '.join(map(str, value.shape))}]. Resize the "
            "images and put their channels first; observations of an encoder of your own go under another key."
        )


def _rows(episodes: TensorDictBase | list[TensorDictBase], name: str) -> list[TensorDictBase]:
    """Episodes ``[T_i]`` one by one."""
    if len(episodes) == 0:
        raise ValueError(f"{name} holds no episode. Leave its tag out.")
    if isinstance(episodes, TensorDictBase):
        if episodes.ndim != 2:
            raise ValueError(f"{name} must have batch size [N, T], got {list(episodes.shape)}.")
        return list(episodes.unbind(0))
    for episode in episodes:
        if episode.ndim != 1:  # not split as the buffer does: what is saved comes back as it was
            raise ValueError(f"{name}: each episode of a list must have batch size [T], got {list(episode.shape)}.")
    return list(episodes)


def _length(rows: list[TensorDictBase]) -> int | None:
    """The steps that all episodes have, or ``None`` where they differ."""
    lengths = {len(row) for row in rows}
    return lengths.pop() if len(lengths) == 1 else None


def save_episodes(
    datasets: Mapping[Tag, TensorDictBase | list[TensorDictBase]],
    folder: str | Path,
    *,
    task: str,
    seed: int,
    keys: EpisodeKeys | None = None,
) -> Path:
    """Write episodes by tag to NumPy files, nothing twice, with a description and checksums beside them.

    Where an entry after a step (``("next", key)``) is the entry before the following step (``key``) throughout, as
    observations are, both are stored as one of ``T + 1`` values for an episode.

    Args:
        datasets: episodes by tag: ``[N, T]``, or a list or lazy stack of episodes ``[T_i]`` of different lengths.
        folder: must not exist yet.
        task: name of the domain.
        seed: seed of the collection.
        keys: where the episodes keep their entries; the defaults of :class:`~ls3_torchrl.data.EpisodeKeys` when
            ``None``.

    Returns:
        The folder.

    Raises:
        FileExistsError: when the folder exists.
        TypeError: for entries that are not tensors.
        OSError: naming the file, when it cannot be written, as on a full disk; then nothing is left.

    It also raises what :func:`~ls3_torchrl.data.check_episodes` does.
    """
    folder = Path(folder)
    if folder.exists():
        raise FileExistsError(f"{folder} exists already. Choose another folder, or remove it first.")
    sets: dict[str, list[TensorDictBase]] = {}
    for tag, episodes in datasets.items():
        name = Tag.parse(tag).name.lower()
        sets[name] = rows = checked_rows(episodes, keys or EpisodeKeys(), name)
        _require_tensors(rows, name)
    with new_folder(folder) as new:
        description = {
            "format": FORMAT,
            "version": VERSION,
            "task": task,
            "seed": seed,
            "episodes": {name: [len(row) for row in rows] for name, rows in sets.items()},
            "entries": {name: _write(rows, new, name) for name, rows in sets.items()},
        }
        save_json_atomically(with_checksum(description), new / _DESCRIPTION)
    return folder


def _keys(row: TensorDictBase) -> list[tuple[str, ...]]:
    return [as_tuple(key) for key in row.keys(True, True, is_leaf=is_leaf_nontensor)]


def _require_tensors(rows: list[TensorDictBase], name: str) -> None:
    expected = set(_keys(rows[0]))
    for row in rows:
        if set(_keys(row)) != expected:
            raise ValueError(
                f"{name}: all episodes must have the same keys; these are not in all of them: "
                f"{sorted(expected ^ set(_keys(row)))}. Leave them out with exclude()."
            )
    for key in expected:
        if not isinstance(rows[0].get(key), Tensor):
            raise TypeError(f"{name}: {key} is not a tensor, and only tensors are saved. Leave it out with exclude().")


def _write(rows: list[TensorDictBase], folder: Path, name: str) -> list[Entry]:
    """One file for each entry: all episodes behind one another."""
    keys, entries = _keys(rows[0]), []
    shared = {key for key in keys if key[0] != "next" and _shared(rows, key, ("next", *key))}
    for key in keys:
        values = [row.get(key) for row in rows]
        if key in shared:
            last = [row.get(("next", *key))[-1:] for row in rows]
            parts = [part for pair in zip(values, last, strict=True) for part in pair]
            entries.append(write_array(folder, f"{name}/{_STATES}", key, parts))
        elif key[0] != "next" or key[1:] not in shared:
            entries.append(write_array(folder, f"{name}/{_STEPS}", key, values))
    return entries


def _shared(rows: list[TensorDictBase], key: tuple[str, ...], twin: tuple[str, ...]) -> bool:
    """Whether the entry after each step is, bit by bit, the entry before the following one."""
    for row in rows:
        before, after = row.get(key), row.get(twin, None)
        if not (isinstance(before, Tensor) and isinstance(after, Tensor)):
            return False
        if before.dtype != after.dtype or before.shape != after.shape or before.is_complex():
            return False
        if not torch.equal(_bits(before[1:]), _bits(after[:-1])):
            return False
    return True


def _bits(values: Tensor) -> Tensor:
    """Values as integers: 0.0 is not −0.0, and NaN is itself."""
    kinds = {1: torch.int8, 2: torch.int16, 4: torch.int32, 8: torch.int64}
    return values.view(kinds[values.element_size()])


def load_episodes(
    folder: str | Path, *, task: str | None = None, keys: EpisodeKeys | None = None
) -> dict[Tag, TensorDictBase]:
    """Read episodes written by :func:`save_episodes`. Nothing in the folder is run as code: no pickles are read.

    Args:
        folder: where they lie.
        task: the domain that they must be of, if any.
        keys: where the episodes keep their entries; the defaults of :class:`~ls3_torchrl.data.EpisodeKeys` when
            ``None``.

    Returns:
        Episodes ``[N, T]`` by tag, or a lazy stack of episodes ``[T_i]`` where their lengths differ. All entries are
        mapped from the disk; writing into them changes no file.

    Raises:
        FileNotFoundError: when the folder has no description, or a file of it is missing.
        ValueError: for another format, version or domain, or for a damaged file: sizes and checksums are looked at.
    """
    folder = Path(folder)
    path = folder / _DESCRIPTION
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} holds no episodes: {_DESCRIPTION} is missing. Write some with save_episodes(), or `ls3 collect`."
        )
    description = load_json(path, f"a description of episodes ({FORMAT})")
    kind, version = description.get("format"), description.get("version")
    if kind != FORMAT or version not in (1, 2, VERSION):
        raise ValueError(
            f"{folder} holds {(kind, version)}, but {FORMAT!r} of version 1, 2 or {VERSION} is read here. "
            "Collect again."
        )
    if version == VERSION:
        require_checksum(description, path)
    if task is not None and description.get("task") != task:
        raise ValueError(f"{folder} holds episodes of {description.get('task')!r}, but {task!r} is wanted.")
    datasets: dict[Tag, TensorDictBase] = {}
    for name, lengths in _lengths(description, path).items():
        if version == VERSION:
            flat = {_flat_key(entry, name): read_array(folder, entry) for entry in description["entries"][name]}
        else:
            flat = read_memory_maps(folder / name)
        episodes = _read_first_version(flat, lengths, path) if version == 1 else _read(flat, lengths, path)
        check_episodes(episodes, keys=keys, name=name)
        datasets[Tag.parse(name)] = episodes
    return datasets


def _flat_key(entry: Entry, name: str) -> tuple[str, ...]:
    return (entry["branch"].removeprefix(f"{name}/"), *entry["key"])


def _lengths(description: Mapping[str, Any], path: Path) -> dict[str, list[int]]:
    """Steps of the episodes by tag."""
    told, tags = description.get("episodes"), {tag.name.lower() for tag in Tag}
    if isinstance(told, dict) and all(
        name in tags and isinstance(lengths, list) and lengths and all(type(n) is int and n > 0 for n in lengths)
        for name, lengths in told.items()
    ):
        return told
    raise ValueError(
        f"{path} does not say how many steps the episodes of each tag have: it is damaged. Use another copy of it."
    )


def _require_count(key: tuple[str, ...], values: Tensor, count: int, path: Path) -> None:
    if values.ndim == 0 or len(values) != count:
        raise ValueError(
            f"{path} promises {count} values of {'.'.join(key)}, where {list(values.shape)} are stored: it is damaged. "
            "Use another copy of the folder."
        )


def _read_first_version(flat: dict[tuple[str, ...], Tensor], batch: list[int], path: Path) -> TensorDictBase:
    """Of the first version, which kept everything as ``[N, T, ...]``."""
    out = TensorDict({}, batch)
    for key, values in flat.items():
        if list(values.shape[:2]) != list(out.batch_size):
            raise ValueError(
                f"{path} promises {list(out.batch_size)} steps, where {'.'.join(key)} has {list(values.shape)}: it is "
                "damaged. Use another copy of the folder."
            )
        out.set(key, values)
    return out


def _read(flat: dict[tuple[str, ...], Tensor], lengths: list[int], path: Path) -> TensorDictBase:
    """Views of what :func:`_write` has written."""
    for key, values in flat.items():
        _require_count(key, values, sum(lengths) + (len(lengths) if key[0] == _STATES else 0), path)
    if len(set(lengths)) == 1:
        return _view(flat, len(lengths), lengths[0], 0, 0)
    rows, start = [], 0
    for number, steps in enumerate(lengths):
        rows.append(_view(flat, 1, steps, start, number)[0])
        start += steps
    return LazyStackedTensorDict.lazy_stack(rows, 0)


def _view(flat: dict[tuple[str, ...], Tensor], episodes: int, steps: int, start: int, number: int) -> TensorDict:
    """So many episodes of so many steps, from the step ``start`` of all on, which belongs to episode ``number``."""
    out = TensorDict({}, [episodes, steps])
    for (branch, *rest), values in flat.items():
        key: NestedKey = tuple(rest)
        if branch == _STEPS:
            out.set(key, values[start : start + episodes * steps].unflatten(0, (episodes, steps)))
        else:
            first = start + number  # each episode before it has one state more than steps
            states = values[first : first + episodes * (steps + 1)].unflatten(0, (episodes, steps + 1))
            out.set(key, states[:, :-1])
            out.set(("next", *rest), states[:, 1:])
    return out
