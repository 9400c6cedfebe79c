"""The rows of a buffer: what is kept of each step of an episode."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import NestedKey, NonTensorData, TensorDict, TensorDictBase
from torch import Tensor

from ls3_torchrl.data.keys import EpisodeKeys, as_tuple
from ls3_torchrl.data.labels import after_violation, in_success, reward_to_go, timed_out
from ls3_torchrl.data.tags import Tag

#: Entries of rows that an episode's own must not be called.
OWN_KEYS: frozenset[NestedKey] = frozenset(
    [
        *("tag", "in_success", "after_violation", "timed_out", "reward_to_go", "frame", "steps_left", "index"),
        *("loc", "scale", "latent", ("next", "loc"), ("next", "scale"), ("next", "latent")),
    ]
)


def require_free(keys: Iterable[NestedKey]) -> None:
    """Raise ``ValueError`` for keys that rows need for themselves, or that lie below or above one of these."""
    own = [as_tuple(key) for key in OWN_KEYS]
    taken = sorted(
        str(key) for key in keys if any(as_tuple(key)[: len(mine)] == mine[: len(as_tuple(key))] for mine in own)
    )
    if taken:
        raise ValueError(f"The keys {taken} are the buffer's own. Rename these entries of the episodes.")


def episode_rows(
    episode: TensorDictBase,
    posteriors: TensorDictBase,
    tag: Tag,
    *,
    keys: EpisodeKeys,
    extra_keys: Iterable[NestedKey] = (),
    gamma: float,
) -> TensorDict:
    """The steps of an episode with their labels and posteriors.

    Args:
        episode: ``[T]``, from its first step on.
        posteriors: ``loc`` and ``scale`` of its observations, float32 ``[T + 1, D]``.
        tag: where it comes from.
        keys: where it keeps its entries.
        extra_keys: further entries that are kept.
        gamma: γ of the ``reward_to_go``.

    Returns:
        ``[T]``.
    """
    steps = len(episode)
    reward, constraint, success = (episode.get(key) for key in (keys.reward, keys.constraint, keys.success))
    rows = TensorDict(
        {
            "tag": torch.full((steps, 1), int(tag), dtype=torch.uint8),
            "in_success": in_success(success),
            "after_violation": after_violation(constraint),
            "timed_out": timed_out(success, constraint),
            "reward_to_go": reward_to_go(reward, gamma),
            "steps_left": torch.arange(steps, 0, -1).unsqueeze(-1),
        },
        [steps],
    )
    for key in (keys.action, keys.reward, keys.constraint, keys.success, *extra_keys):
        rows.set(key, episode.get(key))
    for name in ("loc", "scale"):
        rows.set(name, posteriors[name][:-1])
        rows.set(("next", name), posteriors[name][1:])
    return rows


def tag_of(episode: TensorDictBase) -> Tag:
    """The tag that an episode ``[T]`` carries under ``tag``; online where it carries none.

    Raises:
        ValueError: for an unknown tag, or several.
    """
    tag = episode.get("tag", None)
    if tag is None:
        return Tag.ONLINE
    if not isinstance(tag, Tensor):
        return Tag.parse(tag.data if isinstance(tag, NonTensorData) else tag)
    numbers = tag.unique().tolist()
    if len(numbers) != 1:
        raise ValueError(f"An episode has one tag, got {numbers} under 'tag'. Split it where the tag changes.")
    return Tag.parse(numbers[0])
