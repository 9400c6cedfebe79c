"""Episodes to Minari, Farama's format of offline data."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec

from ls3_torchrl._checks import action_bounds
from ls3_torchrl.data.conform import require_actions
from ls3_torchrl.data.dataset import checked_rows
from ls3_torchrl.data.keys import EpisodeKeys, as_tuple
from ls3_torchrl.data.packages import require_package
from ls3_torchrl.data.tags import Tag


def save_minari(
    datasets: Mapping[Tag, TensorDictBase | list[TensorDictBase]],
    dataset_id: str,
    *,
    action_spec: TensorSpec | None = None,
    extra_keys: Iterable[NestedKey] = (),
    keys: EpisodeKeys | None = None,
    **about: Any,
) -> Any:
    """Write episodes by tag as a Minari dataset, bit by bit, for Minari's own reader and all that build on it.

    Minari keeps T + 1 observations and infos for T steps. Images have their channels last there, as in Gymnasium, and
    are stored without loss. Violations and successes lie in ``infos``, under ``"constraint"`` and ``"success"``: each
    tells of the state, and the first state, which no step leads to, has ``False``. The tag lies in the metadata of each
    episode, under ``"tag"``.

    Args:
        datasets: episodes by tag, as :func:`~ls3_torchrl.data.save_episodes` takes them.
        dataset_id: of the dataset, with its version, such as ``"mine/robot-v0"``. It goes to the folder that
            ``MINARI_DATASETS_PATH`` names, ``~/.minari/datasets`` by default.
        action_spec: bounds of the actions; without one the action space has none.
        extra_keys: further entries of states to keep, such as ``"state"``. With any, observations are a dictionary, in
            which images and states lie under their keys.
        keys: where the episodes keep their entries; the defaults of :class:`~ls3_torchrl.data.EpisodeKeys` when
            ``None``.
        about: ``author``, ``author_email``, ``algorithm_name``, ``code_permalink``, ``description``, ``requirements``,
            ``env``, ``eval_env`` and ``data_format``, as ``minari.create_dataset_from_buffers`` takes them.

    Returns:
        The ``minari.MinariDataset``.

    Raises:
        ModuleNotFoundError: when Minari, or h5py, is not installed.
        FileExistsError: when there is such a dataset.
        ValueError: for an id without version, actions outside of the spec, or observations that were taken anew for
            each step, for which Minari has no room.

    It also raises what :func:`~ls3_torchrl.data.check_episodes` does. When anything fails, nothing is left.

    Source:
        Minari 0.5, https://minari.farama.org.

    Example:
        >>> import os, tempfile
        >>> from unittest.mock import patch
        >>> from ls3_torchrl.data import episode_from_arrays
        >>> pixels, reached = np.zeros((10, 3, 64, 64), dtype=np.uint8), np.arange(9) == 8
        >>> episode = episode_from_arrays(pixels, np.zeros((9, 2)), reached - 1.0, np.zeros(9), reached)
        >>> with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, MINARI_DATASETS_PATH=folder):
        ...     written = save_minari({Tag.SUCCESS: [episode]}, "mine/robot-v0", author="me")[0]
        >>> written.observations.shape, written.infos["success"].tolist()[-2:]
        ((10, 64, 64, 3), [False, True])
    """
    minari = require_package("minari", "save_minari")
    require_package("h5py", "save_minari")
    keys, more = keys or EpisodeKeys(), [unravel_key(key) for key in extra_keys]
    sets: dict[Tag, list[TensorDictBase]] = {}
    for tag, some in _by_tag(datasets).items():
        sets[tag] = checked_rows(some, keys, tag.name.lower())
    rows = [row for some in sets.values() for row in some]
    states = [_states(row, (keys.observation, *more), name) for name, some in _named(sets) for row in some]
    _require_alike(rows, states, keys)
    action = torch.cat([row[keys.action] for row in rows])
    if action_spec is not None:
        require_actions(action, action_spec, repr(keys.action))
    folder = _free_folder(dataset_id)
    about = {
        "action_space": _action_space(action, action_spec),
        "observation_space": _observation_space(states[0]),
        **about,
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it asks for an author, an environment and more
            buffers = [_buffer(row, state, keys) for row, state in zip(rows, states, strict=True)]
            made = minari.create_dataset_from_buffers(dataset_id, buffers, jpeg_encoding=False, **about)
            tags = [{"tag": tag.name.lower()} for tag, some in sets.items() for _ in some]
            made.storage.update_episode_metadata(tags)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return minari.load_dataset(dataset_id)


def _by_tag(datasets: Mapping[Tag, Any]) -> dict[Tag, Any]:
    if not isinstance(datasets, Mapping):
        raise TypeError(
            f"Episodes are saved by tag, got {type(datasets).__name__}. Give a mapping such as {{Tag.SUCCESS: rows}}."
        )
    if not datasets:
        raise ValueError("There are no episodes to save, got an empty mapping. Give episodes by tag.")
    return {Tag.parse(tag): rows for tag, rows in datasets.items()}


def _named(sets: Mapping[Tag, list[TensorDictBase]]) -> Iterable[tuple[str, list[TensorDictBase]]]:
    return ((tag.name.lower(), rows) for tag, rows in sets.items())


def _free_folder(dataset_id: str) -> Any:
    """Where Minari will put a dataset."""
    parse = require_package("minari.dataset.minari_dataset", "save_minari", "minari").parse_dataset_id
    folders = require_package("minari.storage.datasets_root_dir", "save_minari", "minari")
    try:
        parse(dataset_id)
    except (ValueError, TypeError) as error:
        raise ValueError(
            "dataset_id must be a name of letters, digits, - and _ with a version, in a namespace of at least two "
            f"letters or in none, such as 'mine/robot-v0'; got {dataset_id!r}."
        ) from error
    folder = folders.get_dataset_path(dataset_id)
    if folder.exists():
        raise FileExistsError(
            f"{folder} exists already. Choose another name or version, or remove it: minari.delete_dataset("
            f"{dataset_id!r})."
        )
    return folder


def _states(row: TensorDictBase, names: tuple[NestedKey, ...], who: str) -> dict[tuple[str, ...], np.ndarray]:
    """The T + 1 states of an episode, images with channels last; by key."""
    out = {}
    for name in names:
        before, after = (row.get(key, None) for key in (name, ("next", *as_tuple(name))))
        if not isinstance(before, Tensor) or not isinstance(after, Tensor):
            raise KeyError(
                f"{who}: {name!r} must be there before and after each step, under itself and under 'next'. Leave it "
                "out of extra_keys."
            )
        if before.dtype == torch.bool or before.is_complex():
            raise TypeError(f"{who}: {name!r} must be numbers, got {before.dtype}. Give it as float32 or uint8.")
        if not torch.equal(before[1:], after[:-1]):
            raise ValueError(
                f"{who}: ('next', {name!r}) is not {name!r} of the step after it: observations were taken anew. Minari "
                "keeps T + 1 of them for T steps; save_episodes() keeps them all."
            )
        values = torch.cat([before, after[-1:]]).cpu()
        is_image = values.dtype == torch.uint8 and values.ndim == 4
        out[as_tuple(name)] = (values.movedim(1, -1) if is_image else values).contiguous().numpy()
    return out


def _require_alike(
    rows: list[TensorDictBase], states: list[dict[tuple[str, ...], np.ndarray]], keys: EpisodeKeys
) -> None:
    """Refuse episodes, of one tag or another, that do not fit in one space."""
    kinds = [{key: (value.dtype, value.shape[1:]) for key, value in state.items()} for state in states]
    sizes = [row[keys.action].shape[-1] for row in rows]
    for kind, size in zip(kinds, sizes, strict=True):
        if kind != kinds[0] or size != sizes[0]:
            raise ValueError(
                f"A Minari dataset has one kind of observations and actions, got {kinds[0]} with {sizes[0]} actions "
                f"and {kind} with {size}. Save them as two datasets."
            )


def _observation_space(states: Mapping[tuple[str, ...], np.ndarray]) -> Any:
    spaces = require_package("gymnasium.spaces", "save_minari", "gymnasium")
    if len(states) == 1:
        (values,) = states.values()
        return _box(values)
    tree = _tree({key: _box(values) for key, values in states.items()})
    return _dict_space(tree, spaces)


def _dict_space(tree: Mapping[str, Any], spaces: Any) -> Any:
    return spaces.Dict(
        {key: _dict_space(part, spaces) if isinstance(part, dict) else part for key, part in tree.items()}
    )


def _box(values: np.ndarray, low: Any = None, high: Any = None) -> Any:
    """The space of rows ``[n, ...]``: all that their type can hold, unless told otherwise."""
    spaces = require_package("gymnasium.spaces", "save_minari", "gymnasium")
    if low is None:
        whole = np.iinfo(values.dtype) if np.issubdtype(values.dtype, np.integer) else None
        low, high = (-np.inf, np.inf) if whole is None else (whole.min, whole.max)
    return spaces.Box(low, high, values.shape[1:], values.dtype.type)


def _action_space(actions: Tensor, spec: TensorSpec | None) -> Any:
    if spec is None:
        return _box(actions.cpu().numpy())
    # What rounding has put beyond a bound belongs to the space as well.
    low, high = (bound.float().to(actions) for bound in action_bounds(spec))
    ends = torch.minimum(low, actions.amin(0)), torch.maximum(high, actions.amax(0))
    return _box(actions.cpu().numpy(), *(end.cpu().numpy() for end in ends))


def _tree(flat: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    """Values under nested keys as nested dictionaries."""
    tree: dict[str, Any] = {}
    for (*outer, last), value in flat.items():
        inner = tree
        for part in outer:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return tree


def _buffer(row: TensorDictBase, states: Mapping[tuple[str, ...], np.ndarray], keys: EpisodeKeys) -> Any:
    """An episode as Minari takes it."""
    collector = require_package("minari.data_collector", "save_minari", "minari")
    terminated, truncated = _ends(row)
    infos = {}
    for name, key in (("constraint", keys.constraint), ("success", keys.success)):
        flags = row.get(key).flatten().cpu().numpy()
        infos[name] = [False, *flags.tolist()]  # a list: Minari does not read arrays of numbers back from Parquet
    return collector.EpisodeBuffer(
        observations=next(iter(states.values())) if len(states) == 1 else _tree(states),
        actions=row.get(keys.action).cpu().numpy(),
        rewards=row.get(keys.reward).flatten().cpu().numpy(),
        terminations=terminated,
        truncations=truncated,
        infos=infos,
    )


def _ends(row: TensorDictBase) -> tuple[np.ndarray, np.ndarray]:
    """Which steps terminate and which truncate; an episode that does not say how it ends is truncated."""
    nothing = torch.zeros(len(row), 1, dtype=torch.bool)
    done, terminated, truncated = (
        row.get(("next", key), nothing).reshape(len(row), -1).any(-1).cpu()
        for key in ("done", "terminated", "truncated")
    )
    truncated = truncated | (done & ~terminated)
    truncated[-1] |= ~terminated[-1]
    return terminated.numpy(), truncated.numpy()
