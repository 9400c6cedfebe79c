"""Episodes in the form that buffer and files keep: what is clear is converted, and said; what is not is refused."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec

from ls3_torchrl._checks import DataWarning, action_bounds, require_finite, require_keys
from ls3_torchrl.data.episodes import Episodes, split_episodes
from ls3_torchrl.data.keys import EpisodeKeys, as_tuple
from ls3_torchrl.data.tags import Tag

#: How far outside the box an action may lie, as a fraction of its width: what rounding does.
_ROUNDING = 1e-4


def conform(
    episodes: Sequence[TensorDictBase], keys: EpisodeKeys, extra_keys: Iterable[NestedKey] = (), *, who: str
) -> list[TensorDictBase]:
    """Episodes ``[T]`` with the dtypes and shapes that are kept; entries of other keys stay as they are.

    Args:
        episodes: each from its first step on.
        keys: where they keep their entries.
        extra_keys: further entries that are kept.
        who: who asks, for messages.

    Returns:
        Copies that share what needs no conversion; nothing in them has a graph.

    Raises:
        KeyError: for a missing key.
        TypeError: for entries that are no tensors, or images of another dtype.
        ValueError: for anything else that cannot be understood; the message names key, shape and remedy.

    Warns:
        DataWarning: once, naming all that was converted.
    """
    said: dict[str, None] = {}  # in order, and each once
    out = [_conform(episode, keys, tuple(extra_keys), who, said) for episode in episodes]
    _require_alike(out, (*keys.required, *extra_keys), who)
    if said:
        warnings.warn(f"{who} converted {'; '.join(said)}.", DataWarning, stacklevel=4)
    return out


def _conform(
    episode: TensorDictBase, keys: EpisodeKeys, extra_keys: tuple[NestedKey, ...], who: str, said: dict[str, None]
) -> TensorDictBase:
    require_keys(episode, (*keys.required, *extra_keys), who)
    steps = len(episode)
    if steps == 0:
        raise ValueError(f"{who}: an episode has no step. Leave it out.")
    out = episode.copy()
    for key in (*keys.required, *extra_keys):
        value = episode.get(key)
        if not isinstance(value, Tensor) or value.layout != torch.strided or value.is_meta or value.is_nested:
            kind = type(value).__name__ if not isinstance(value, Tensor) else f"one of {value.layout} on {value.device}"
            raise TypeError(
                f"{who}: {key!r} must be an ordinary tensor, got {kind}. Give numbers, for example to_dense()."
            )
        out.set(key, value.detach())
    for key in (keys.reward, keys.constraint, keys.success):
        _require_column(out.get(key), key, steps, who)
    action = out.get(keys.action)
    if action.ndim != 2:
        raise ValueError(
            f"{who}: {keys.action!r} must have shape [T, A], got {list(action.shape)}. Give each action one dimension."
        )
    out.set(keys.action, as_float32(action, keys.action, said))
    out.set(keys.reward, as_float32(out.get(keys.reward), keys.reward, said))
    for key in (keys.constraint, keys.success):
        out.set(key, _labels(out.get(key), key, who, said))
    for key in (keys.observation, keys.next_observation):
        out.set(key, _observation(out.get(key), key, who, said))
    _require_one_way(out, keys, who)
    for key in (keys.action, keys.reward, keys.observation, keys.next_observation, *extra_keys):
        require_finite(out.get(key), f"{who}: {_shown(key)}")
    _require_rewards(out, keys, who)
    return out


def _shown(key: NestedKey) -> str:
    return key if isinstance(key, str) else repr(key)


def _require_column(value: Tensor, key: NestedKey, steps: int, who: str) -> None:
    if value.shape != (steps, 1):
        raise ValueError(
            f"{who}: {key!r} must have shape [T, 1] with T = {steps} steps, got {list(value.shape)}. Give one value "
            "for each step, with unsqueeze(-1) where they are [T]; episode_from_arrays() takes either."
        )


def as_float32(value: Tensor, key: NestedKey, said: dict[str, None]) -> Tensor:
    """Numbers in the precision that is kept."""
    if value.dtype == torch.float32:
        return value
    if value.is_complex():
        raise TypeError(f"{key!r} must be real numbers, got {value.dtype}. Give float32.")
    said[f"{key!r} from {value.dtype} to torch.float32"] = None
    return value.float()


def _labels(value: Tensor, key: NestedKey, who: str, said: dict[str, None]) -> Tensor:
    """Labels as bools."""
    if value.dtype == torch.bool:
        return value
    other = value[(value != 0) & (value != 1)]
    if len(other):
        raise ValueError(
            f"{who}: {key!r} must hold bools, or 0 and 1; got {other[0].item()} among {len(value)} values of dtype "
            f"{value.dtype}. Compare with a threshold first, for example cost > 0."
        )
    said[f"{key!r} from {value.dtype} of 0 and 1 to bools"] = None
    return value.bool()


def _observation(value: Tensor, key: NestedKey, who: str, said: dict[str, None]) -> Tensor:
    """Observations: states as float32, images as uint8 where the key says that they are images."""
    if value.dtype == torch.float64:
        value = as_float32(value, key, said)
    if as_tuple(key)[-1] != "pixels" or value.ndim != 4 or value.dtype == torch.uint8:
        return value
    require_finite(value, f"{who}: {_shown(key)}")
    low, high = (float(end) for end in value.aminmax())
    if value.is_floating_point() and low >= 0 and high <= 1:  # as the encoder reads them, too
        scaled = value * 255.0
        if bool(((scaled - scaled.round()).abs() < 1e-2).all()):
            said[f"{key!r} from {value.dtype} in [0, 1] to torch.uint8 in 0..255"] = None
            return scaled.round().to(torch.uint8)
    raise TypeError(
        f"{who}: {key!r} must be uint8 images in 0..255, got {value.dtype} from {low:.4g} to {high:.4g}. Give "
        "images.byte() where they lie in 0..255, (255 * images).round().byte() where they lie in [0, 1]; observations "
        "of an encoder of your own go under another key."
    )


def _require_one_way(episode: TensorDictBase, keys: EpisodeKeys, who: str) -> None:
    """Refuse steps that do not follow one another: the observation after each is the one before the next."""
    before, after = episode.get(keys.observation), episode.get(keys.next_observation)
    if before.shape != after.shape or before.dtype != after.dtype:
        raise ValueError(
            f"{who}: {keys.observation!r} and {keys.next_observation} must be alike, got {before.dtype} "
            f"{list(before.shape)} and {after.dtype} {list(after.shape)}. Give both in one shape and type."
        )
    if len(episode) < 3 or (before[1:].data_ptr() == after[:-1].data_ptr() and before.stride() == after.stride()):
        return
    jumps = (before[1:] != after[:-1]).flatten(1).any(1).nonzero().flatten()
    # Where all differ, every observation was taken anew, as cameras do; where few do, an episode ends there.
    if 0 < len(jumps) < (len(episode) - 1) / 2:
        raise ValueError(
            f"{who}: what follows step {int(jumps[0])} does not begin where it ends: {keys.next_observation} there is "
            f"not {keys.observation!r} of the step after, as it is elsewhere. An episode seems to end within a row: "
            "split it, or mark its last step under ('next', 'done')."
        )


def _require_rewards(episode: TensorDictBase, keys: EpisodeKeys, who: str) -> None:
    reward, success = episode.get(keys.reward), episode.get(keys.success)
    if success.any() and torch.equal(reward, success.to(reward)):
        raise ValueError(
            f"{who}: {keys.reward!r} is 1 in the goal and 0 elsewhere, but LS³ needs 0 in the goal and -1 elsewhere: "
            "it takes a reward of 0 for the goal. Subtract 1."
        )


def _require_alike(episodes: list[TensorDictBase], keys: Iterable[NestedKey], who: str) -> None:
    """Refuse episodes whose entries differ in shape or dtype."""
    for episode in episodes[1:]:
        for key in keys:
            one, other = episodes[0].get(key), episode.get(key)
            if one.shape[1:] != other.shape[1:] or one.dtype != other.dtype:
                raise ValueError(
                    f"{who}: {key!r} differs among the episodes: {one.dtype} {list(one.shape[1:])} and {other.dtype} "
                    f"{list(other.shape[1:])} for each step. Give all in one shape and type."
                )


def check_datasets(
    datasets: Mapping[Tag, Episodes], *, action_spec: TensorSpec | None = None, keys: EpisodeKeys | None = None
) -> None:
    """Check whole sets of offline data against what they are for, before hours are spent on them.

    Args:
        datasets: episodes by tag, as :func:`~ls3_torchrl.data.load_episodes` returns them.
        action_spec: of the environment or robot that the agent will act in; its actions are not looked at when
            ``None``.
        keys: where the episodes keep their entries; the defaults of :class:`~ls3_torchrl.data.EpisodeKeys` when
            ``None``.

    Raises:
        ValueError: for another number of actions than the spec has, actions outside its box, rewards of 0 outside of
            the goal, or entries that differ among the sets.
        KeyError, TypeError: as by the buffer, for episodes that it would refuse.

    Warns:
        DataWarning: for successful demonstrations that never succeed, or violating ones that never violate.

    Example:
        >>> from torchrl.data import Bounded
        >>> from ls3_torchrl.data import episode_from_arrays
        >>> reached = torch.arange(9) > 6
        >>> reward = reached.float() - 1
        >>> episode = episode_from_arrays(torch.zeros(10, 4), torch.zeros(9, 2), reward, torch.zeros(9), reached)
        >>> check_datasets({Tag.SUCCESS: [episode]}, action_spec=Bounded(-1.0, 1.0, shape=(2,)))
    """
    keys = keys or EpisodeKeys()
    sets = {}
    for given, episodes in datasets.items():
        tag = Tag.parse(given)
        name = tag.name.lower()
        sets[tag] = conform(split_episodes(episodes), keys, who=name)
        if not sets[tag]:
            raise ValueError(f"{name} holds no episode. Leave its tag out.")
        for episode in sets[tag]:
            if action_spec is not None:
                require_actions(episode.get(keys.action), action_spec, f"{name}: {_shown(keys.action)}")
            require_cost_outside(episode.get(keys.reward), episode.get(keys.success), f"{name}: {_shown(keys.reward)}")
    _require_alike([episodes[0] for episodes in sets.values()], keys.required, "The sets of episodes")
    labels = {Tag.SUCCESS: (keys.success, "succeeds"), Tag.CONSTRAINT: (keys.constraint, "violates a constraint")}
    for tag, (key, verb) in labels.items():
        if tag in sets and not any(bool(episode.get(key).any()) for episode in sets[tag]):
            warnings.warn(
                f"No episode of {len(sets[tag])} that are tagged {tag.name.lower()} ever {verb}: {_shown(key)} is "
                "false throughout. Check how it is computed.",
                DataWarning,
                stacklevel=2,
            )


def require_actions(actions: Tensor, spec: TensorSpec, what: str) -> None:
    """Raise ``ValueError`` for actions ``[n, A]`` that nobody can have carried out.

    Args:
        actions: float32.
        spec: of the environment or robot.
        what: how messages call them.
    """
    low, high = (bound.to(actions) for bound in action_bounds(spec))
    if actions.shape[-1] != len(low):
        raise ValueError(
            f"{what} has {actions.shape[-1]} actions, where the action spec has {len(low)}. Give the actions that the "
            "robot carries out."
        )
    excess = torch.maximum(low - actions, actions - high) > _ROUNDING * (high - low)
    if excess.any():
        raise ValueError(
            f"{what} lies outside of what can be carried out in {int(excess.any(-1).sum())} of {len(actions)} steps: "
            f"it goes from {[round(float(x), 4) for x in actions.amin(0)]} to "
            f"{[round(float(x), 4) for x in actions.amax(0)]}, allowed are {[round(float(x), 4) for x in low]} to "
            f"{[round(float(x), 4) for x in high]}. Convert its unit, or clamp it as the robot did."
        )


def require_cost_outside(reward: Tensor, success: Tensor, what: str) -> None:
    """Raise ``ValueError`` for rewards that are 0 outside of the goal throughout: 0 is what marks the goal."""
    outside = ~success
    if outside.any() and not reward[outside].any():
        raise ValueError(
            f"{what} is 0 in all {int(outside.sum())} steps outside of the goal, which LS³ takes for the goal. Give -1 "
            "there and 0 in the goal: subtract 1 from a reward of 0 and 1."
        )
