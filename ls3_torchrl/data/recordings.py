"""Episodes from recordings of another format: where their entries, labels and tags come from."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import torch
from tensordict import LazyStackedTensorDict, NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from ls3_torchrl._checks import DataWarning
from ls3_torchrl.data.conform import require_cost_outside
from ls3_torchrl.data.dataset import check_episodes
from ls3_torchrl.data.episodes import episode_from_arrays
from ls3_torchrl.data.keys import EpisodeKeys, as_tuple
from ls3_torchrl.data.tags import Tag

#: Where an entry comes from: its name, a function of the recorded episode, or one answer for all steps.
Source: TypeAlias = NestedKey | bool | Callable[[Any], Any]
#: The tag of all episodes, or a function of the recorded episode.
TagSource: TypeAlias = Tag | str | Callable[[Any], Tag | str]


@dataclass(frozen=True)
class Recording:
    """A recorded episode of another format.

    Args:
        recorded: what functions get.
        name: how messages call it.
        steps: T.
        entries: its arrays by name, ``[T, ...]`` of steps or ``[T + 1, ...]`` of states.
        defaults: of which entry a source is that is not given.
        tag: which it was stored with, if any.
    """

    recorded: Any
    name: str
    steps: int
    entries: Mapping[tuple[str, ...], Any]
    defaults: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    tag: str | None = None


@dataclass(frozen=True)
class Sources:
    """Where actions, rewards, labels, tags and further entries of episodes come from; as the loaders take them."""

    action: Source | None = None
    reward: Source | None = None
    constraint: Source | None = None
    success: Source | None = None
    tag: TagSource | None = None
    extra: Mapping[NestedKey, Source] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.tag is not None and not callable(self.tag):
            Tag.parse(self.tag)  # before anything is read

    def values(self, recording: Recording, what: str) -> np.ndarray:
        """What a source says: ``[T, ...]`` of steps, or ``[T + 1, ...]`` of states.

        Raises:
            KeyError: for an entry that is not there, or a source that was not given and has no default.
            TypeError: for anything but numbers and bools.
            ValueError: for another number of values.
        """
        return read_source(recording, getattr(self, what), what)

    def of_steps(self, recording: Recording, what: str) -> np.ndarray:
        """What a source says of each step, ``[T, ...]``: of states, that of the one after it."""
        return self.values(recording, what)[-recording.steps :]


def read_source(recording: Recording, source: Source | None, what: str) -> np.ndarray:
    """The array that a source names or makes; see :meth:`Sources.values`."""
    if isinstance(source, bool):
        return np.full(recording.steps, source)
    if callable(source):
        try:
            values = source(recording.recorded)
        except Exception as error:
            error.add_note(f"This came from the function {what}= for {recording.name}.")
            raise
    else:
        values = _entry(recording, source, what)
    array = values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
    if array.ndim == 0 or len(array) not in (recording.steps, recording.steps + 1):
        raise ValueError(
            f"{recording.name}: {what} must have one value for each of the {recording.steps} steps, or for each of the "
            f"{recording.steps + 1} states, got shape {list(array.shape)}. Check the function or entry that it is "
            "taken from."
        )
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{recording.name}: {what} must be numbers or bools, got {array.dtype}. Convert it first.")
    return array


def _entry(recording: Recording, source: NestedKey | None, what: str) -> Any:
    """An entry by its name, or by the last part of it where no other has that."""
    default = recording.defaults.get(what)
    wanted = default if source is None else as_tuple(unravel_key(source))
    names = ", ".join(_shown(name) for name in recording.entries) or "nothing"
    if wanted is None:
        also = f", or {what}=False where it never is" if what in ("constraint", "success") else ""
        raise KeyError(
            f"{recording.name} does not say what its {what} is: no entry is called so. Give {what}= the name of one, "
            f"or a function of the episode{also}. It has: {names}."
        )
    if wanted in recording.entries:
        return recording.entries[wanted]
    ends = [name for name in recording.entries if name[-len(wanted) :] == wanted]
    if len(ends) != 1:
        problem = "has no" if not ends else "has more than one"
        raise KeyError(f"{recording.name} {problem} entry {_shown(wanted)!r} for {what}. It has: {names}.")
    return recording.entries[ends[0]]


def _shown(name: tuple[str, ...]) -> str:
    return name[0] if len(name) == 1 else repr(name)


def make_episode(
    recording: Recording, observations: Any, sources: Sources, keys: EpisodeKeys
) -> tuple[Tag, TensorDictBase]:
    """An episode of a recording, checked, and its tag.

    Args:
        recording: with what its labels come from.
        observations: ``[T + 1, ...]``.
        sources: where the other entries come from.
        keys: under which keys all go.

    Raises:
        ValueError: as :func:`~ls3_torchrl.data.check_episodes`; each message names the episode.
    """
    labels = [sources.of_steps(recording, what) for what in ("action", "reward", "constraint", "success")]
    try:
        episode = episode_from_arrays(observations, *labels, keys=keys)
    except ValueError as error:
        raise ValueError(f"{recording.name}: {error}") from error
    for key, source in sources.extra.items():
        if unravel_key(key) in keys.required or as_tuple(unravel_key(key))[0] == "next":
            raise ValueError(
                f"extra= must name keys of its own, none of {keys.required} nor under 'next'; got {key!r}."
            )
        values = torch.tensor(read_source(recording, source, str(key)))
        if len(values) > recording.steps:
            episode[key], episode[("next", *as_tuple(key))] = values[:-1], values[1:]
        else:
            episode[key] = values
    check_episodes([episode], keys=keys, name=recording.name)
    require_cost_outside(episode[keys.reward], episode[keys.success], f"{recording.name}: {keys.reward!r}")
    return _tag(recording, episode, sources, keys), episode


def _tag(recording: Recording, episode: TensorDictBase, sources: Sources, keys: EpisodeKeys) -> Tag:
    """What is told, what was stored, or what the labels say."""
    told = sources.tag(recording.recorded) if callable(sources.tag) else sources.tag
    told = recording.tag if told is None else told
    if told is not None:
        return Tag.parse(told)
    if episode[keys.constraint].any():
        return Tag.CONSTRAINT
    return Tag.SUCCESS if episode[keys.success].any() else Tag.RAND


def episodes_by_tag(
    episodes: Iterable[tuple[Tag, TensorDictBase]], sources: Sources, keys: EpisodeKeys, who: str
) -> dict[Tag, TensorDictBase]:
    """Lazy stacks ``[N, T_i]`` by tag, in the order of the tags; nothing is copied.

    Raises:
        ValueError: when there are none.

    Warns:
        DataWarning: for recorded rewards that are not −1 outside of the goal and 0 in it.
    """
    rows: dict[Tag, list[TensorDictBase]] = {tag: [] for tag in Tag}
    for tag, episode in episodes:
        rows[tag].append(episode)
    if not any(rows.values()):
        raise ValueError(f"{who} has no episode. Give another one, or other episodes= of it.")
    if sources.reward is None:
        _warn_of_rewards([episode for some in rows.values() for episode in some], keys, who)
    return {tag: LazyStackedTensorDict.lazy_stack(some, 0) for tag, some in rows.items() if some}


def _warn_of_rewards(episodes: list[TensorDictBase], keys: EpisodeKeys, who: str) -> None:
    for episode in episodes:
        reward, success = episode[keys.reward], episode[keys.success]
        if not torch.equal(reward, success.to(reward) - 1.0):
            warnings.warn(
                f"{who}: the recorded rewards, from {float(reward.min()):.4g} to {float(reward.max()):.4g} in one "
                "episode, are kept, but are not -1 outside of the goal and 0 in it, as LS³ takes them. Give reward= a "
                "function of the episode, for example that of success=, minus 1.",
                DataWarning,
                stacklevel=4,
            )
            return


def chosen(wanted: Iterable[int] | None, there: Iterable[int], who: str) -> Iterator[int]:
    """The numbers of the episodes that are read: all that are there, or those wanted.

    Raises:
        ValueError: for one that is not there.
    """
    known = list(there)
    for number in known if wanted is None else list(wanted):
        if number not in known:
            raise ValueError(f"{who} has no episode {number}: its {len(known)} are {_range(known)}. Choose among them.")
        yield number


def _range(numbers: list[int]) -> str:
    return f"{min(numbers)} to {max(numbers)}" if numbers else "none"
