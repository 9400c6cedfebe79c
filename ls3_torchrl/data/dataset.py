"""Save, load and check collected episodes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import LazyStackedTensorDict, NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec

from ls3_torchrl.data.arrays import keys_of, read_arrays, require_file_names, write_arrays
from ls3_torchrl.data.bounds import require_within
from ls3_torchrl.data.canonical import Form, canonical, forms, require_alike, require_tensor, say
from ls3_torchrl.data.episodes import Episodes, require_single
from ls3_torchrl.data.keys import EpisodeKeys
from ls3_torchrl.data.tags import VALUE_TAGS, Tag
from ls3_torchrl.files import checksum_of, file_manifest, new_folder, read_json, save_json_atomically, verify_files

FORMAT = "ls3_torchrl.episodes"
VERSION = 3
_DESCRIPTION = "episodes.json"
_REMEDY = "Restore the folder from a copy, or collect again."
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
        ValueError: for wrong batch sizes or shapes, rows that are not one whole episode, observations that are not
            those that follow, labels other than 0 and 1, rewards that are 1 in the goal, or numbers that are not
            finite.
        TypeError: for images that are not uint8, actions and rewards that are no numbers, or entries that are not
            tensors.

    Warns:
        DataWarning: of actions, rewards and observations that are rounded to float32, and of rewards of 0 throughout
            an episode that never succeeds.

    Example:
        >>> from ls3_torchrl.data import episode_from_arrays
        >>> keys = EpisodeKeys(observation="state")
        >>> no = torch.zeros(9)
        >>> episode = episode_from_arrays(torch.zeros(10, 4), torch.zeros(9, 2), -torch.ones(9), no, no, keys=keys)
        >>> check_episodes([episode], keys=keys)
    """
    said: list[str] = []
    _checked(episodes, keys or EpisodeKeys(), name, said)
    say(said, stacklevel=2)


def check_datasets(
    datasets: Mapping[Tag, Episodes], *, action_spec: TensorSpec | None = None, keys: EpisodeKeys | None = None
) -> None:
    """Check whole sets of episodes against one another, and against the actions of a domain, before training on them.

    Args:
        datasets: episodes by tag, as :func:`load_episodes` gives them.
        action_spec: bounds of an action ``[A]`` or batched, such as ``env.action_spec``; unchecked when ``None``.
        keys: where the episodes keep their entries; the defaults of :class:`~ls3_torchrl.data.EpisodeKeys` when
            ``None``.

    Raises:
        ValueError: for another number of actions, actions outside of their bounds, or tags whose entries differ in
            shape or type.
        Further: as :func:`check_episodes`.

    Warns:
        DataWarning: where no episode of those that values are learnt from ever succeeds, none of those tagged
            ``constraint`` ever violates, or rewards in the goal are lower than outside; and as :func:`check_episodes`.

    Example:
        >>> from torchrl.data import Bounded
        >>> from ls3_torchrl.data import episode_from_arrays
        >>> keys = EpisodeKeys(observation="state")
        >>> violated, reached = torch.zeros(9), (torch.arange(9) == 8).float()
        >>> arrays = torch.zeros(10, 4), torch.zeros(9, 2), reached - 1, violated, reached
        >>> episode = episode_from_arrays(*arrays, keys=keys)
        >>> check_datasets({Tag.SUCCESS: [episode]}, action_spec=Bounded(-1, 1, (2,)), keys=keys)
        >>> check_datasets({Tag.SUCCESS: [episode]}, action_spec=Bounded(-1, 1, (3,)), keys=keys)
        Traceback (most recent call last):
            ...
        ValueError: success: actions have 2 dimensions, but those of the action spec 3. Use data of the same actions.
    """
    keys = keys or EpisodeKeys()
    said: list[str] = []
    first: tuple[str, dict[NestedKey, Form]] | None = None
    sets = {Tag.parse(tag): episodes for tag, episodes in datasets.items()}
    outcomes: dict[Tag, Tensor] = {}
    for tag, episodes in sets.items():
        name = tag.name.lower()
        parts = _checked(_as_parts(episodes), keys, name, said)
        form = forms(parts[0], keys.required)
        first = first or (name, form)
        require_alike(form, first[1], name, f"{first[0]!r} has")
        if action_spec is not None:
            for part in parts:
                require_within(part.get(keys.action), action_spec, name)
        outcomes[tag] = torch.stack([_outcome(part, keys) for part in parts]).sum(0)
    _judge(outcomes, said)
    say(said, stacklevel=2)


def _as_parts(episodes: Episodes) -> TensorDictBase | list[TensorDictBase]:
    """A single episode is a set of one."""
    if isinstance(episodes, TensorDictBase):
        return episodes.unsqueeze(0) if episodes.ndim == 1 else episodes
    return list(episodes)


def _outcome(part: TensorDictBase, keys: EpisodeKeys) -> Tensor:
    """Of steps: how many succeed, violate, and there are; and the sums of rewards in the goal and outside."""
    success, reward = part.get(keys.success), part.get(keys.reward).double()
    sums = reward[success].sum(), reward[~success].sum()
    counts = success.sum(), part.get(keys.constraint).sum(), success.numel()
    return torch.stack([torch.as_tensor(value, dtype=torch.float64).cpu() for value in (*counts, *sums)])


def _judge(outcomes: dict[Tag, Tensor], said: list[str]) -> None:
    values = [outcome for tag, outcome in outcomes.items() if tag in VALUE_TAGS]
    if values:
        succeed, _, steps, inside, outside = torch.stack(values).sum(0).tolist()
        if succeed == 0:
            said.append(
                "There is no success in the data that values are learnt from (success, online): no episode ever "
                "succeeds. Check their success labels; without any, nothing about the goal can be learnt."
            )
        elif steps > succeed and inside / succeed < outside / (steps - succeed) - 1e-6:
            said.append(
                f"Rewards in the goal ({inside / succeed:.3g} in the mean) are lower than outside of it "
                f"({outside / (steps - succeed):.3g}): the agent would learn to stay away. Check the rewards' sign."
            )
    if Tag.CONSTRAINT in outcomes and outcomes[Tag.CONSTRAINT][1] == 0:
        said.append(
            "There is no violation in the data tagged 'constraint': no step ever violates. Check their constraint "
            "labels; without any, the constraint cannot be learnt."
        )


def _checked(
    episodes: TensorDictBase | list[TensorDictBase], keys: EpisodeKeys, name: str, said: list[str]
) -> list[TensorDictBase]:
    """Episodes in the form in which they are stored: ``[N, T]`` in one, or ``[T_i]`` each."""
    rows = _rows(episodes, name)
    # Whole sets are checked at once where they can be: a pass over each episode of its own takes longer.
    at_once = isinstance(episodes, TensorDictBase) and len({len(row) for row in rows}) == 1
    parts = [cast(TensorDictBase, episodes)] if at_once else rows
    if at_once and isinstance(episodes, LazyStackedTensorDict):
        parts = [torch.stack([*rows])] if len({frozenset(keys_of(row)) for row in rows}) == 1 else rows
    for part in parts:
        require_single(part, name)
    parts = [canonical(part, keys, name=name, said=said) for part in parts]
    form = forms(parts[0], keys.required)
    for part in parts[1:]:
        require_alike(forms(part, keys.required), form, name, "another episode")
    return parts


def _rows(episodes: TensorDictBase | list[TensorDictBase], name: str) -> list[TensorDictBase]:
    """Episodes ``[T_i]`` one by one."""
    if len(episodes) == 0:
        raise ValueError(f"{name} holds no episode. Leave its tag out.")
    if isinstance(episodes, TensorDictBase):
        if episodes.ndim != 2:
            raise ValueError(f"{name} must have batch size [N, T], got {list(episodes.shape)}.")
        return list(episodes.unbind(0))
    if not isinstance(episodes, (list, tuple)) or not all(isinstance(episode, TensorDictBase) for episode in episodes):
        raise TypeError(f"{name} must be a TensorDict or a list of them, got {type(episodes).__name__} of others.")
    for episode in episodes:
        if episode.ndim != 1:  # not split as the buffer does: what is saved comes back as it was
            raise ValueError(f"{name}: each episode of a list must have batch size [T], got {list(episode.shape)}.")
    return list(episodes)


def save_episodes(
    datasets: Mapping[Tag, TensorDictBase | list[TensorDictBase]],
    folder: str | Path,
    *,
    task: str,
    seed: int,
    keys: EpisodeKeys | None = None,
) -> Path:
    """Write episodes by tag to files, nothing twice, with a description of them and their checksums.

    Where an entry after a step (``("next", key)``) is the entry before the following step (``key``) throughout, as
    observations are, both are stored as one of ``T + 1`` values for an episode. Everything is checked before anything
    is written, and the folder is there as a whole or not at all: what a save leaves that was killed ends in
    ``.partial``, and can be removed.

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
        ValueError: for entries that cannot be names of files.
        OSError: on a full disk; names the file, and nothing is left.
        Further, and warns: as :func:`check_episodes`; what was converted is saved as it was converted.
    """
    folder, keys = Path(folder), keys or EpisodeKeys()
    said: list[str] = []
    if folder.exists():
        raise FileExistsError(f"{folder} exists already. Choose another folder, or remove it first.")
    if not isinstance(datasets, Mapping) or not datasets:
        raise ValueError(f"datasets must hold episodes by tag, got {datasets!r:.80}. Nothing was saved.")
    sets: dict[str, list[TensorDictBase]] = {}
    for tag, episodes in datasets.items():
        name = Tag.parse(tag).name.lower()
        parts = _checked(episodes, keys, name, said)
        sets[name] = [row for part in parts for row in (part.unbind(0) if part.ndim == 2 else [part])]
        _require_alike(sets[name], name)
    lengths = {name: [len(row) for row in rows] for name, rows in sets.items()}
    description: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "task": task,
        "seed": seed,
        "episodes": lengths,
    }
    checksum_of(description)  # fails now when JSON cannot hold the task or seed
    say(said, stacklevel=2)
    with new_folder(folder) as inside:
        for name, rows in sets.items():
            (inside / name).mkdir()
            write_arrays(inside / name, _arrays(rows), [])
        description["files"] = file_manifest(inside)
        save_json_atomically({**description, "checksum": checksum_of(description)}, inside / _DESCRIPTION)
    return folder


def _require_alike(rows: list[TensorDictBase], name: str) -> None:
    """All episodes must have the same entries, which files can hold."""
    expected = set(keys_of(rows[0]))
    require_file_names(expected, name)
    for row in rows:
        if set(keys_of(row)) != expected:
            raise ValueError(
                f"{name}: all episodes must have the same keys; these are not in all of them: "
                f"{sorted(expected ^ set(keys_of(row)))}. Leave them out with exclude()."
            )
    for key in expected:
        for row in rows:
            value = row.get(key)
            if not isinstance(value, Tensor):
                raise TypeError(
                    f"{name}: {key} is not a tensor, and only tensors are saved. Leave it out with exclude()."
                )
            require_tensor(value, key, name)
    form = forms(rows[0], list(expected))
    for row in rows[1:]:
        require_alike(forms(row, list(expected)), form, name, "another episode")


def _arrays(rows: list[TensorDictBase]) -> dict[tuple[str, ...], Iterator[Tensor]]:
    """The parts of one file for each entry: all episodes behind one another."""
    keys = keys_of(rows[0])
    shared = {key for key in keys if key[0] != "next" and _shared(rows, key, ("next", *key))}
    arrays: dict[tuple[str, ...], Iterator[Tensor]] = {}
    for key in keys:
        if key in shared:
            arrays[_STATES, *key] = _states(rows, key)
        elif key[0] != "next" or key[1:] not in shared:
            arrays[_STEPS, *key] = _steps(rows, key)
    return arrays


def _steps(rows: list[TensorDictBase], key: tuple[str, ...]) -> Iterator[Tensor]:
    for row in rows:
        yield row.get(key)


def _states(rows: list[TensorDictBase], key: tuple[str, ...]) -> Iterator[Tensor]:
    for row in rows:
        yield row.get(key)
        yield row.get(("next", *key))[-1:]


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
    """Read episodes written by :func:`save_episodes`, of this version or those before.

    Nothing in the folder is run as code: only arrays are read. Nothing in it is written either: writing into what was
    loaded changes no file. Sizes and checksums of all files are verified first, which takes about half a second for
    each GB, once it is in memory; of versions 1 and 2, which have no checksums, the sizes.

    Args:
        folder: where they lie.
        task: the domain that they must be of, if any.
        keys: where the episodes keep their entries; the defaults of :class:`~ls3_torchrl.data.EpisodeKeys` when
            ``None``.

    Returns:
        Episodes ``[N, T]`` by tag, or a lazy stack of episodes ``[T_i]`` where their lengths differ. All entries are
        views of memory maps, which are read as they are used.

    Raises:
        FileNotFoundError: when the folder has no description, or lacks a file; names it.
        ValueError: for a file that is damaged, names it; for another format, version or domain; or as
            :func:`check_episodes`.
    """
    folder, keys = Path(folder), keys or EpisodeKeys()
    said: list[str] = []
    lengths, version = _describe(folder, task)
    datasets: dict[Tag, TensorDictBase] = {}
    for name, steps in lengths.items():
        arrays = read_arrays(folder / name, remedy=_REMEDY)
        if not arrays:
            raise ValueError(f"{folder / name} is damaged: it has no arrays. {_REMEDY}")
        episodes = _read_first(arrays, steps, folder / name) if version == 1 else _read(arrays, steps, folder / name)
        parts = _checked(episodes, keys, f"{folder}, {name}", said)
        datasets[Tag.parse(name)] = parts[0] if parts[0].ndim == 2 else LazyStackedTensorDict.lazy_stack(parts, 0)
    say(said, stacklevel=2)
    return datasets


def _describe(folder: Path, task: str | None) -> tuple[dict[str, list[int]], int]:
    """The episodes' lengths by tag and the version, from a description that fits the files."""
    path = folder / _DESCRIPTION
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} holds no episodes: {_DESCRIPTION} is missing. Write some with save_episodes(), or `ls3 collect`."
        )
    about = read_json(path, remedy=_REMEDY)
    kind, version = about.get("format"), about.get("version")
    if kind != FORMAT or type(version) is not int or version not in (1, 2, VERSION):
        raise ValueError(
            f"{folder} holds {(kind, version)}, but {FORMAT!r} of version 1 to {VERSION} is read here. Collect again."
        )
    if version < VERSION and {"files", "checksum"} & set(about):
        raise ValueError(f"{path} is damaged: it has entries that its version {version} has not. {_REMEDY}")
    if version == VERSION and about.pop("checksum", None) != checksum_of(about):
        raise ValueError(f"{path} is damaged, or was edited: its checksum is another. {_REMEDY}")
    lengths = about.get("episodes")
    if not isinstance(lengths, dict) or not lengths:
        raise ValueError(f"{path} is damaged: it names no episodes by tag, but {lengths!r}. {_REMEDY}")
    names = [tag.name.lower() for tag in Tag]
    for name, steps in lengths.items():
        if name not in names:
            raise ValueError(f"{path} names episodes of {name!r}, but there are only {', '.join(names)}. {_REMEDY}")
        if not isinstance(steps, list) or not steps or not all(type(count) is int and count > 0 for count in steps):
            raise ValueError(f"{path} is damaged: the lengths of {name!r} are {steps!r:.80}. {_REMEDY}")
    if task is not None and about.get("task") != task:
        raise ValueError(f"{folder} holds episodes of {about.get('task')!r}, but {task!r} is wanted.")
    if version == VERSION:
        verify_files(folder, about.get("files"), remedy=_REMEDY)
    return lengths, version


def _read_first(arrays: dict[tuple[str, ...], Tensor], shape: list[int], folder: Path) -> TensorDictBase:
    """Episodes of version 1: arrays ``[N, T, ...]``."""
    for key, values in arrays.items():
        if len(shape) != 2 or list(values.shape[:2]) != shape:
            raise ValueError(f"{folder} is damaged: {key} has shape {list(values.shape)} for {shape} steps. {_REMEDY}")
    episodes = TensorDict({}, shape)
    for key, values in arrays.items():
        episodes.set(key, values)
    return episodes


def _read(flat: dict[tuple[str, ...], Tensor], lengths: list[int], folder: Path) -> TensorDictBase:
    """Views of what :func:`save_episodes` has written."""
    rows_of = {_STATES: sum(lengths) + len(lengths), _STEPS: sum(lengths)}
    for (branch, *rest), values in flat.items():
        if not rest or branch not in rows_of or not values.ndim or len(values) != rows_of[branch]:
            raise ValueError(
                f"{folder} is damaged: {(branch, *rest)} has shape {list(values.shape)}, but {_DESCRIPTION} tells of "
                f"{len(lengths)} episodes of {sum(lengths)} steps. {_REMEDY}"
            )
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
