"""Episodes in the one form that is stored: what is wrong is refused, what differs in type alone is converted."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase, is_tensor_collection
from torch import Tensor

from ls3_torchrl._checks import DataWarning, require_finite, require_keys
from ls3_torchrl.data.keys import EpisodeKeys, as_tuple

#: Shape and dtype of an entry of one step.
Form = tuple[torch.Size, torch.dtype]
_SIDE = 64


def canonical(
    episodes: TensorDictBase,
    keys: EpisodeKeys,
    *,
    extra_keys: Iterable[NestedKey] = (),
    images: bool = True,
    name: str,
    said: list[str],
) -> TensorDictBase:
    """Whole episodes as they are stored: float32 actions and rewards, bool labels, observations that follow on.

    Args:
        episodes: ``[*B, T]``.
        keys: where they keep their entries.
        extra_keys: further entries that must be there.
        images: whether observations under ``"pixels"`` must be images; else vectors ``[n]`` are taken too.
        name: how to call them in messages.
        said: what was converted, or is suspicious, is appended; see :func:`say`.

    Returns:
        The same, or a shallow copy where an entry was converted.

    Raises:
        KeyError: for missing entries.
        TypeError: for entries of a wrong type.
        ValueError: for wrong shapes or values.
    """
    require_keys(episodes, (*keys.required, *extra_keys), name)
    if episodes.numel() == 0:
        raise ValueError(f"{name}: an episode holds no step, batch size {list(episodes.shape)}. Leave it out.")
    changed: dict[NestedKey, Tensor] = {}
    for key in (*keys.required, *extra_keys):
        for leaf in leaves(episodes, key):
            value = require_tensor(episodes.get(leaf), leaf, name)
            if key in extra_keys:
                require_finite(value, f"{name}: {_show(leaf)}")
    action = _numbers(episodes, keys.action, keys, name, said)
    if action.ndim != episodes.ndim + 1 or action.shape[-1] == 0:
        raise ValueError(
            f"{name}: {_show(keys.action)} must have shape {_shape(episodes, 'A')}, got {list(action.shape)}. "
            "Flatten actions to one dimension; give a single one by unsqueeze(-1)."
        )
    reward = _column(_numbers(episodes, keys.reward, keys, name, said), episodes, keys.reward, name)
    changed |= {keys.action: action, keys.reward: reward}
    for key in (keys.constraint, keys.success):
        changed[key] = flags(_column(episodes.get(key), episodes, key, name), f"{name}: {_show(key)}")
    changed |= _observations(episodes, keys, images, name, said)
    _check_reward(reward, changed[keys.success], keys, name, said)
    changed = {key: value for key, value in changed.items() if value is not episodes.get(key)}
    if changed:
        episodes = episodes.copy()
        for key, value in changed.items():
            episodes.set(key, value)
    return episodes


def say(said: Sequence[str], stacklevel: int) -> None:
    """Warn once of all that was found, each finding named once."""
    if said:
        unique = list(dict.fromkeys(said))
        more = f" And {len(unique) - 5} more findings of this kind." if len(unique) > 5 else ""
        warnings.warn(" ".join(unique[:5]) + more, DataWarning, stacklevel=stacklevel + 1)


def leaves(data: TensorDictBase, key: NestedKey) -> list[NestedKey]:
    """The entries at or below a key."""
    value = data.get(key)
    if not isinstance(value, TensorDictBase):
        return [key]
    return [(*as_tuple(key), *as_tuple(inner)) for inner in value.keys(True, True)]


def require_tensor(value: object, key: NestedKey, name: str) -> Tensor:
    """Return ``value`` when it is an ordinary tensor; raise ``TypeError`` otherwise."""
    if not isinstance(value, Tensor) or is_tensor_collection(value):
        kind = type(value).__name__
    elif value.is_nested or value.layout != torch.strided or value.device.type == "meta":
        kind = f"nested, sparse or meta tensor of {value.dtype}"
    else:
        return value
    raise TypeError(f"{name}: {_show(key)} must be an ordinary (strided) tensor, got a {kind}. Convert it first.")


def flags(values: Tensor, what: str) -> Tensor:
    """Labels as bools, from bools or numbers that are 0 and 1.

    Raises:
        TypeError: for complex numbers.
        ValueError: for other values; names one.
    """
    if values.dtype == torch.bool:
        return values
    other = values[(values != 0) & (values != 1)]
    if len(other):
        raise ValueError(
            f"{what} must hold bools, or 0 and 1; got {other[0].item()} among {values.numel()} values of dtype "
            f"{values.dtype}. Compare with a threshold first, for example cost > 0."
        )
    return values.bool()


def forms(episode: TensorDictBase, keys: Iterable[NestedKey]) -> dict[NestedKey, Form]:
    """Shape and dtype that the entries of one step have."""
    dims = episode.ndim
    found = {leaf: episode.get(leaf) for key in keys for leaf in leaves(episode, key)}
    return {key: (value.shape[dims:], value.dtype) for key, value in found.items()}


def require_alike(mine: dict[NestedKey, Form], others: dict[NestedKey, Form], name: str, whose: str) -> None:
    """Raise ``ValueError`` where entries differ in shape or type from those that they are to lie beside."""
    for key, (shape, dtype) in mine.items():
        if others.get(key, (shape, dtype)) != (shape, dtype):
            there, kind = others[key]
            raise ValueError(
                f"{name}: {_show(key)} has shape {list(shape)} and {dtype} for each step, but {whose} "
                f"{list(there)} and {kind}. Give all episodes in one shape and type."
            )
    differing = sorted(map(str, mine.keys() ^ others.keys()))
    if differing:
        raise ValueError(f"{name}: the entries {', '.join(differing)} are not in all episodes. Give all or none.")


def _show(key: NestedKey) -> str:
    return repr(key) if isinstance(key, tuple) else key


def _shape(episodes: TensorDictBase, *rest: str) -> str:
    return f"[{', '.join((*(['T'] if episodes.ndim == 1 else ['N', 'T']), *rest))}]"


def _numbers(episodes: TensorDictBase, key: NestedKey, keys: EpisodeKeys, name: str, said: list[str]) -> Tensor:
    """Actions or rewards as finite float32."""
    value, what = episodes.get(key), f"{name}: {_show(key)}"
    if value.dtype == torch.bool or value.is_complex():
        raise TypeError(f"{what} must hold real numbers, got {value.dtype}. Convert it to float32 as it is meant.")
    require_finite(value, what)
    if value.dtype == torch.float32:
        return value
    out = value.float()
    require_finite(out, f"{what}, as float32,")
    if not value.is_floating_point() and key == keys.action:
        said.append(f"{what} is {value.dtype}: it is taken as numbers in a box, not as indices of discrete actions.")
    elif not torch.equal(out.to(value.dtype), value):
        said.append(f"{what} is {value.dtype} and was rounded to float32.")
    return out


def _column(value: Tensor, episodes: TensorDictBase, key: NestedKey, name: str) -> Tensor:
    if value.shape != (*episodes.shape, 1):
        few = " Append the last dimension by unsqueeze(-1)." if value.shape == episodes.shape else ""
        raise ValueError(
            f"{name}: {_show(key)} must have shape {_shape(episodes, '1')}, one value for each of the steps "
            f"{list(episodes.shape)}; got {list(value.shape)}.{few or ' Reduce it to one value for each step.'}"
        )
    return value


def _observations(
    episodes: TensorDictBase, keys: EpisodeKeys, images: bool, name: str, said: list[str]
) -> dict[NestedKey, Tensor]:
    """Observations before and after each step, which follow one another."""
    before, after = (episodes.get(key) for key in (keys.observation, keys.next_observation))
    if before.shape != after.shape or before.dtype != after.dtype:
        raise ValueError(
            f"{name}: {_show(keys.observation)} and {keys.next_observation} must be alike, got {before.dtype} "
            f"{list(before.shape)} and {after.dtype} {list(after.shape)}. Give both in one shape and type."
        )
    if before.ndim == episodes.ndim or before.shape[episodes.ndim :].numel() == 0:
        raise ValueError(
            f"{name}: {_show(keys.observation)} must have shape {_shape(episodes, '...')} with at least one number for "
            f"each step, got {list(before.shape)}. Give a single number by unsqueeze(-1)."
        )
    if keys.observation == "pixels" and (images or before.ndim > episodes.ndim + 1):
        for key, value in ((keys.observation, before), (keys.next_observation, after)):
            _check_image(value, episodes, f"{name}: {_show(key)}")
    for key, value in ((keys.observation, before), (keys.next_observation, after)):
        require_finite(value, f"{name}: {_show(key)}")
    if before.dtype == torch.float64:
        before, after, wide = before.float(), after.float(), (before, after)
        for key, value in ((keys.observation, before), (keys.next_observation, after)):
            require_finite(value, f"{name}: {_show(key)}, as float32,")
        if not all(torch.equal(new.double(), old) for new, old in zip((before, after), wide, strict=True)):
            said.append(f"{name}: {_show(keys.observation)} is torch.float64 and was rounded to float32.")
    _require_following(before, after, episodes.ndim - 1, keys, name)
    return {keys.observation: before, keys.next_observation: after}


def _check_image(value: Tensor, episodes: TensorDictBase, what: str) -> None:
    """Images are uint8 ``[C, 64, 64]``, as :class:`~ls3_torchrl.modules.PixelEncoder` takes them."""
    wanted, shape = _shape(episodes, "C", str(_SIDE), str(_SIDE)), list(value.shape)
    elsewhere = "Observations of another kind go under another key, with EpisodeKeys(observation=...)."
    if value.ndim == episodes.ndim + 3 and shape[-3:-1] == [_SIDE, _SIDE] and shape[-1] != _SIDE:
        raise ValueError(f"{what} must have shape {wanted}, got {shape}: channels come first. Use movedim(-1, -3).")
    if value.ndim == episodes.ndim + 2 and shape[-2:] == [_SIDE, _SIDE]:
        raise ValueError(f"{what} must have shape {wanted}, got {shape}. Add the channel by unsqueeze(-3).")
    if value.ndim != episodes.ndim + 3 or shape[-2:] != [_SIDE, _SIDE] or shape[-3] == 0:
        raise ValueError(f"{what} must have shape {wanted}, got {shape}. Resize images to 64 x 64. {elsewhere}")
    if value.dtype == torch.uint8:
        return
    if value.is_complex() or value.dtype == torch.bool:
        raise TypeError(f"{what} must be uint8 in 0..255, got {value.dtype}. {elsewhere}")
    require_finite(value, what)
    low, high = float(value.min()), float(value.max())
    remedy = (
        "Convert them by (255 * images).round().to(torch.uint8)."
        if low >= 0.0 and high <= 1.0 and value.is_floating_point()
        else "Convert them by images.round().to(torch.uint8)."
        if low >= 0.0 and high <= 255.0
        else "Bring them back to 0..255 and convert them by to(torch.uint8)."
    )
    raise TypeError(
        f"{what} must be uint8 in 0..255, got {value.dtype} in [{low:.4g}, {high:.4g}]. {remedy} {elsewhere}"
    )


def _require_following(before: Tensor, after: Tensor, dim: int, keys: EpisodeKeys, name: str) -> None:
    """Of the observation after a step and that before the following one only one is kept: they must be the same."""
    steps = before.shape[dim]
    follows, follow = before.narrow(dim, 1, steps - 1), after.narrow(dim, 0, steps - 1)
    if torch.equal(follows, follow):
        return
    floats = follows.is_floating_point()  # the same numbers, rounded on different ways, are meant alike
    same = torch.isclose(follows, follow, rtol=1e-5, atol=1e-6) if floats else follows == follow
    jumps = (~same.flatten(dim + 1).all(-1)).nonzero()
    if len(jumps) == 0:
        return
    *episode, step = jumps[0].tolist()
    where = f" of episode {episode[0]}" if episode else ""
    raise ValueError(
        f"{name}: the observation after step {step}{where} ({keys.next_observation}) is not the one before step "
        f"{step + 1} ({_show(keys.observation)}); so it is at {len(jumps)} of {same.flatten(dim + 1)[..., 0].numel()} "
        "steps. Steps of an episode follow one another, and only one of the two is kept. If an episode ends there (a "
        "reset within a row), split the rows; if noise was added, add the same to both."
    )


def _check_reward(reward: Tensor, success: Tensor, keys: EpisodeKeys, name: str, said: list[str]) -> None:
    """Rewards of LS³ are −1 outside the goal and 0 in it: where they are 0 outside, every state counts as the goal."""
    if success.any():
        if torch.equal(reward, success.to(reward.dtype)):
            raise ValueError(
                f"{name}: {_show(keys.reward)} is 1 in the goal and 0 outside, but LS³ needs 0 in the goal and -1 "
                "outside: a reward of 0 means that the goal is reached. Subtract 1 from the reward."
            )
    elif not reward.any():
        said.append(
            f"{name}: {_show(keys.reward)} is 0 at every step, which means that the goal is reached, but "
            f"{_show(keys.success)} says that it never is. Where rewards are 1 in the goal and 0 outside, subtract 1."
        )
