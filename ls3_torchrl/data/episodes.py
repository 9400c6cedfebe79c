"""Whole episodes, from arrays of one's own or from what a collector hands over."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, TypeAlias

import torch
from tensordict import LazyStackedTensorDict, NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from ls3_torchrl.data.keys import EpisodeKeys

#: What :func:`split_episodes` takes.
Episodes: TypeAlias = TensorDictBase | list[TensorDictBase] | tuple[TensorDictBase, ...]

_ENDS = tuple(("next", key) for key in ("done", "terminated", "truncated"))
_TRAJECTORY = ("collector", "traj_ids")
_MASKS: tuple[NestedKey, ...] = (("collector", "mask"), "mask")


def episode_from_arrays(
    observations: Any,
    actions: Any,
    rewards: Any,
    constraints: Any,
    successes: Any,
    *,
    keys: EpisodeKeys | None = None,
) -> TensorDict:
    """An episode of T steps from arrays, ready for the buffer and for :func:`~ls3_torchrl.data.save_episodes`.

    Actions and rewards become float32 whatever their type, observations of float64 too; other observations stay as
    they are.

    Args:
        observations: ``[T + 1, ...]``, the one after the last step included. NumPy arrays, tensors or lists, as all
            others.
        actions: ``[T, A]``.
        rewards: ``[T]`` or ``[T, 1]``.
        constraints: whether each step's next state violates a constraint, ``[T]`` or ``[T, 1]``, bools or 0 and 1.
        successes: whether it lies in the goal set, alike.
        keys: under which keys they go; the defaults of :class:`~ls3_torchrl.data.EpisodeKeys` when ``None``.

    Returns:
        ``[T]``.

    Raises:
        ValueError: for a shape that does not fit, or labels other than 0 and 1.

    Example:
        >>> import numpy as np
        >>> violated = reached = np.zeros(9)
        >>> episode = episode_from_arrays(np.zeros((10, 4)), np.zeros((9, 2)), -np.ones(9), violated, reached)
        >>> episode.shape, episode["next", "pixels"].dtype, episode["next", "reward"].shape
        (torch.Size([9]), torch.float32, torch.Size([9, 1]))
    """
    keys = keys or EpisodeKeys()
    action = _tensor(actions).float()
    if action.ndim != 2 or len(action) == 0:
        raise ValueError(
            f"{keys.action!r}: actions must have shape [T, A] with at least one step, got {list(action.shape)}. "
            "Give a single action dimension as [T, 1]."
        )
    steps = len(action)
    observation = _tensor(observations)
    if observation.ndim < 2 or len(observation) != steps + 1:
        raise ValueError(
            f"{keys.observation!r}: observations must have shape [T + 1, ...] with T = {steps} as the actions "
            f"have, got {list(observation.shape)}. Append the observation after the last step; give single numbers as "
            "[T + 1, 1]."
        )
    if observation.dtype == torch.float64:
        observation = observation.float()
    episode = TensorDict({}, [steps])
    episode[keys.observation], episode[keys.next_observation] = observation[:-1], observation[1:]
    episode[keys.action] = action
    episode[keys.reward] = _column(rewards, keys.reward, steps).float()
    for key, labels in ((keys.constraint, constraints), (keys.success, successes)):
        episode[key] = _flags(_column(labels, key, steps), key)
    return episode


def _tensor(values: Any) -> Tensor:
    """A tensor of its own: an episode does not change with the arrays that it was made from."""
    if isinstance(values, Tensor):
        return values.detach().clone()
    if isinstance(values, (list, tuple)) and len(values) and not isinstance(values[0], (bool, int, float)):
        return torch.stack([_tensor(value) for value in values])  # of arrays, which torch.tensor takes one by one
    return torch.tensor(values)


def _column(values: Any, key: NestedKey, steps: int) -> Tensor:
    """Values of steps as ``[T, 1]``."""
    column = _tensor(values)
    if list(column.shape) not in ([steps], [steps, 1]):
        raise ValueError(
            f"{key!r} must have shape [T] or [T, 1] with T = {steps} as the actions have, got "
            f"{list(column.shape)}. Give one value for each step."
        )
    return column.reshape(steps, 1)


def _flags(values: Tensor, key: NestedKey) -> Tensor:
    other = values[(values != 0) & (values != 1)]
    if len(other):
        raise ValueError(
            f"{key!r} must hold bools, or 0 and 1; got {other[0].item()} among {len(values)} values of dtype "
            f"{values.dtype}. Compare with a threshold first, for example cost > 0."
        )
    return values.bool()


def split_episodes(data: Episodes) -> list[TensorDictBase]:
    """Single episodes ``[T]`` from the ways in which whole episodes arrive.

    A step that is done (``("next", "done")``, ``"terminated"`` or ``"truncated"``), or behind which the collector's
    trajectory changes or ``is_init`` is true, ends an episode: what follows it is the next one. Padding that a
    collector's mask names is left out.

    Args:
        data: an episode ``[T]``; several behind one another ``[T_1 + T_2 + ...]``, as a
            ``Collector(..., trajs_per_batch=N)`` writes them; ``[N, T]``, or a lazy stack of N episodes of different
            lengths; or a list of any of these.

    Returns:
        ``[T_i]`` each.

    Raises:
        TypeError: for anything but tensordicts.
        ValueError: for another batch size; or when episodes end within a row, but not with it.

    Example:
        >>> done = torch.tensor([[False], [True], [False], [False], [True]])
        >>> data = TensorDict({"next": {"done": done}}, [5])
        >>> [len(episode) for episode in split_episodes(data)]
        [2, 3]
    """
    if isinstance(data, (list, tuple)):
        return [episode for part in data for episode in split_episodes(part)]
    if not isinstance(data, TensorDictBase):
        raise TypeError(
            f"Episodes must be tensordicts, got {type(data).__name__}. Make one of arrays with episode_from_arrays()."
        )
    if data.ndim not in (1, 2):
        raise ValueError(f"Episodes must have batch size [T] or [N, T], got {list(data.shape)}.")
    if data.ndim == 2:
        # Rows of different lengths have no entry in common: a lazy stack of them is taken apart first.
        return [episode for row in data.unbind(0) for episode in split_episodes(row)]
    if isinstance(data, LazyStackedTensorDict):
        data = data.contiguous()  # single steps, as a collector gathers them
    return _split_row(_without_padding(data))


def _without_padding(row: TensorDictBase) -> TensorDictBase:
    for key in _MASKS:
        mask = row.get(key, None)
        if isinstance(mask, Tensor) and mask.dtype == torch.bool and mask.numel() == len(row) and not mask.all():
            return row[mask.flatten()]
    return row


def _split_row(row: TensorDictBase) -> list[TensorDictBase]:
    ends = done_steps(row)
    last = torch.zeros(len(row), dtype=torch.bool) if ends is None else ends.clone()
    begins = row.get("is_init", None)
    if isinstance(begins, Tensor) and begins.dtype == torch.bool and begins.numel() == len(row):
        last[:-1] |= begins.flatten()[1:].cpu()
    trajectory = row.get(_TRAJECTORY, None)
    if trajectory is not None:
        number = trajectory.flatten().cpu()
        last[:-1] |= number[1:] != number[:-1]
    stops = (last[:-1].nonzero().flatten() + 1).tolist()
    if not stops:
        return [row]
    bounds = [0, *stops, len(row)]
    for start, stop in pairwise(bounds):
        if ends is not None and not ends[stop - 1]:
            raise ValueError(
                f"Steps {start} to {stop - 1} of a row of {len(row)} belong to an episode that does not end with them, "
                "while other episodes of the row do end. Hand over whole episodes: collect with "
                "Collector(..., trajs_per_batch=1), or let frames_per_batch be whole episodes."
            )
    return [row[start:stop] for start, stop in pairwise(bounds)]


def done_steps(row: TensorDictBase) -> Tensor | None:
    """Which steps of ``[T]`` are done, bool ``[T]`` on the CPU; ``None`` where the data do not tell."""
    flags = [row.get(key, None) for key in _ENDS]
    told = [flag.reshape(len(row), -1).any(1).cpu() for flag in flags if flag is not None]
    return torch.stack(told).any(0) if told else None


def steps_into_violation(episodes: Episodes, keys: EpisodeKeys | None = None) -> TensorDictBase:
    """Of every episode that violates, the step whose next state is the first to do so.

    Args:
        episodes: as :func:`split_episodes` takes them.
        keys: of the labels; the defaults when ``None``.

    Returns:
        ``[n]``.

    Raises:
        KeyError: for episodes without the label.
        ValueError: when none violates.

    Example:
        >>> constraint = torch.tensor([[False], [True], [True]])
        >>> episode = TensorDict({"action": torch.arange(3.0)[:, None], "next": {"constraint": constraint}}, [3])
        >>> steps_into_violation([episode, episode])["action"].flatten().tolist()
        [1.0, 1.0]
    """
    key = (keys or EpisodeKeys()).constraint
    found = []
    for episode in split_episodes(episodes):
        violates = episode[key].flatten().nonzero()
        if len(violates):
            found.append(episode[int(violates[0])])
    if not found:
        raise ValueError("None of the episodes violates a constraint. Give violating ones.")
    return torch.stack(found)
