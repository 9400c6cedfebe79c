"""Whole episodes, from arrays of one's own or from what a collector hands over."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
import torch
from tensordict import LazyStackedTensorDict, NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from ls3_torchrl.data.canonical import canonical, flags, say
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

    Actions and rewards become float32 whatever their type, observations of float64 too; labels become bools. Under
    ``"pixels"``, images with their channels last, or of other types than uint8, are converted where there is no doubt
    what is meant, and a :class:`~ls3_torchrl.data.DataWarning` says so. Other observations stay as they are.

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
        TypeError: for anything but numbers.
        ValueError: for a shape that does not fit, labels other than 0 and 1, numbers that are not finite, or rewards
            that are 1 in the goal.

    Example:
        >>> import numpy as np
        >>> violated = reached = np.zeros(9)
        >>> episode = episode_from_arrays(np.zeros((10, 4)), np.zeros((9, 2)), -np.ones(9), violated, reached)
        >>> episode.shape, episode["next", "pixels"].dtype, episode["next", "reward"].shape
        (torch.Size([9]), torch.float32, torch.Size([9, 1]))
    """
    keys = keys or EpisodeKeys()
    action = _tensor(actions, keys.action).float()
    if action.ndim != 2 or len(action) == 0:
        raise ValueError(
            f"{keys.action!r}: actions must have shape [T, A] with at least one step, got {list(action.shape)}. "
            "Give a single action dimension as [T, 1]."
        )
    steps = len(action)
    observation = _tensor(observations, keys.observation)
    if observation.ndim < 2 or len(observation) != steps + 1:
        raise ValueError(
            f"{keys.observation!r}: observations must have shape [T + 1, ...] with T = {steps} as the actions "
            f"have, got {list(observation.shape)}. Append the observation after the last step; give single numbers as "
            "[T + 1, 1]."
        )
    said: list[str] = []
    if keys.observation == "pixels" and observation.ndim == 4:
        observation = _images(observation, said)
    if observation.dtype == torch.float64:
        observation = observation.float()
    episode = TensorDict({}, [steps])
    episode[keys.observation], episode[keys.next_observation] = observation[:-1], observation[1:]
    episode[keys.action] = action
    episode[keys.reward] = _column(rewards, keys.reward, steps).float()
    for key, labels in ((keys.constraint, constraints), (keys.success, successes)):
        episode[key] = flags(_column(labels, key, steps), repr(key))
    episode = canonical(episode, keys, images=False, name="episode_from_arrays", said=said)
    say(said, stacklevel=2)
    return episode


def _images(images: Tensor, said: list[str]) -> Tensor:
    """Images as bytes with their channels first, where there is no doubt what is meant."""
    if list(images.shape[1:3]) == [64, 64] and images.shape[3] != 64:
        said.append(f"The images {list(images.shape)} have their channels last, and were given them first.")
        images = images.movedim(-1, 1).contiguous()
    if images.dtype in (torch.uint8, torch.bool) or images.is_complex() or images.numel() == 0:
        return images
    values = images.double()
    low, high = float(values.min()), float(values.max())  # NaN compares with nothing
    whole = torch.equal(values.round(), values)
    if low >= 0.0 and 1.0 < high <= 255.0 and whole:
        said.append(f"The images are {images.dtype} in 0..255, and were converted to uint8.")
        return values.to(torch.uint8)
    if low >= 0.0 and high <= 1.0 and not whole:
        said.append(f"The images are {images.dtype} in [0, 1], and were converted to uint8 in 0..255.")
        return (255.0 * values).round().to(torch.uint8)
    return images  # zeros and ones alone may be either: they are refused


def _tensor(values: Any, key: NestedKey) -> Tensor:
    """A tensor of its own: an episode does not change with the arrays that it was made from."""
    if isinstance(values, Tensor):
        return values.detach().clone()
    if isinstance(values, np.ndarray):
        values = np.ascontiguousarray(values)  # a mirrored image is read backwards
    try:
        if isinstance(values, (list, tuple)) and len(values) and not isinstance(values[0], (bool, int, float)):
            return torch.stack([_tensor(value, key) for value in values])  # torch.tensor takes arrays one by one
        return torch.tensor(values)
    except (TypeError, ValueError, RuntimeError) as error:
        if str(error).startswith(f"{key!r}"):
            raise
        raise (TypeError if isinstance(error, TypeError) else ValueError)(
            f"{key!r} must be an array of numbers, all rows of one shape; got {type(values).__name__} ({error}). "
            "Convert it with numpy.asarray(..., dtype=numpy.float32) first."
        ) from None


def _column(values: Any, key: NestedKey, steps: int) -> Tensor:
    """Values of steps as ``[T, 1]``."""
    column = _tensor(values, key)
    if list(column.shape) not in ([steps], [steps, 1]):
        raise ValueError(
            f"{key!r} must have shape [T] or [T, 1] with T = {steps} as the actions have, got "
            f"{list(column.shape)}. Give one value for each step."
        )
    return column.reshape(steps, 1)


def split_episodes(data: Episodes) -> list[TensorDictBase]:
    """Single episodes ``[T]`` from the ways in which whole episodes arrive.

    A step that is done (``("next", "done")``, ``"terminated"`` or ``"truncated"``), behind which the collector's
    trajectory changes, or before one with ``is_init``, ends an episode: what follows it is the next one. Padding that
    a mask names (``"mask"`` or ``("collector", "mask")``, one value for each step) is left out.

    Args:
        data: an episode ``[T]``; several behind one another ``[T_1 + T_2 + ...]``, as a
            ``Collector(..., trajs_per_batch=N)`` writes them; ``[N, T]``, or a lazy stack of N episodes of different
            lengths; or a list of any of these.

    Returns:
        ``[T_i]`` each.

    Raises:
        TypeError: for anything else.
        ValueError: for another batch size; when episodes end within a row, but not with it; or for padding between
            steps.

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
            f"Episodes must be TensorDicts, or a list of them; got {type(data).__name__}. Make them of arrays with "
            "episode_from_arrays()."
        )
    if data.ndim not in (1, 2):
        raise ValueError(f"Episodes must have batch size [T] or [N, T], got {list(data.shape)}.")
    if data.ndim == 2:
        # Rows of different lengths have no entry in common: a lazy stack of them is taken apart first.
        return [episode for row in data.unbind(0) for episode in split_episodes(row)]
    if isinstance(data, LazyStackedTensorDict):
        data = data.contiguous()  # single steps, as a collector gathers them
    steps = _real_steps(data)
    return _split_row(data if steps is None else data[steps])


def _real_steps(row: TensorDictBase) -> slice | None:
    """Which steps of a row are no padding, by a collector's mask; ``None`` for all of them."""
    for key in _MASKS:
        mask = row.get(key, None)
        if not isinstance(mask, Tensor) or mask.numel() != len(row) or len(row) == 0:
            continue
        real = (flags(mask, repr(key))).flatten().nonzero().flatten()
        if len(real) == len(row):
            continue
        start, stop = (int(real[0]), int(real[-1]) + 1) if len(real) else (0, 0)
        if stop - start != len(real):
            raise ValueError(
                f"{key!r} marks padding between the steps of a row of {len(row)}: steps {start} to {stop - 1} hold "
                f"{len(real)} real ones. Padding lies at a row's end; take the padded steps out first."
            )
        return slice(start, stop)
    return None


def _split_row(row: TensorDictBase) -> list[TensorDictBase]:
    ends = done_steps(row)
    bounds = [0, *_stops(row, ends), len(row)]
    if len(bounds) == 2:
        return [row]
    for start, stop in pairwise(bounds):
        if ends is not None and not ends[stop - 1]:
            raise ValueError(
                f"Steps {start} to {stop - 1} of a row of {len(row)} belong to an episode that does not end with them, "
                "while other episodes of the row do end. Hand over whole episodes: collect with "
                "Collector(..., trajs_per_batch=1), or let frames_per_batch be whole episodes."
            )
    return [row[start:stop] for start, stop in pairwise(bounds)]


def _stops(row: TensorDictBase, ends: Tensor | None) -> list[int]:
    """The steps within a row at which another episode begins."""
    last = torch.zeros(len(row), dtype=torch.bool) if ends is None else ends.clone()
    trajectory, first = row.get(_TRAJECTORY, None), row.get("is_init", None)
    if isinstance(trajectory, Tensor) and trajectory.numel() == len(row):
        number = trajectory.flatten().cpu()
        last[:-1] |= number[1:] != number[:-1]
    if isinstance(first, Tensor) and first.numel() == len(row):
        last[:-1] |= first.flatten().cpu().bool()[1:]
    return (last[:-1].nonzero().flatten() + 1).tolist()


def require_single(episodes: TensorDictBase, name: str) -> None:
    """Raise ``ValueError`` where a row of ``[*B, T]`` is not one episode: it holds padding, or others begin within.

    What is saved comes back as it was: nothing is split on the way.
    """
    for number, row in enumerate(episodes.unbind(0) if episodes.ndim == 2 else [episodes]):
        if _real_steps(row) is not None or _stops(row, done_steps(row)):
            raise ValueError(
                f"{name}: row {number} of {len(row)} steps is not one whole episode: it holds padding, or an episode "
                "ends within it. Pass split_episodes(data) instead."
            )


def done_steps(row: TensorDictBase) -> Tensor | None:
    """Which steps of ``[T]`` are done, bool ``[T]`` on the CPU; ``None`` where the data do not tell."""
    found = [row.get(key, None) for key in _ENDS]
    told = [flag.reshape(len(row), -1).any(1).cpu() for flag in found if isinstance(flag, Tensor) and flag.numel()]
    return torch.stack(told).any(0) if told else None
