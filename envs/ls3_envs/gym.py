"""The domains as Gymnasium environments: ``gymnasium.make("ls3/Reacher-v0")`` and ``gymnasium.make_vec``."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ls3_envs._checks import whole_number
from ls3_envs.base import ACTION_TOLERANCE
from ls3_envs.making import make
from ls3_envs.registry import domain as row_of
from ls3_envs.seeding import checked_seed

_FRAMES_PER_SECOND = 20

#: What an environment's ``info`` says, as far as the domain has it; ``cost`` is added.
_FLAGS = ("constraint", "success", "physics_error")


def _images(pixels: Tensor) -> np.ndarray:
    """Channels first to channels last, as Gymnasium's image wrappers expect them."""
    return np.ascontiguousarray(pixels.movedim(-3, -1).cpu().numpy())


class _Batch:
    """A batch of a domain's environments, in NumPy, with the spaces of one."""

    def __init__(
        self, domain: str, num_envs: int, render_mode: str | None, render_size: int | None, options: dict[str, Any]
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}.")
        if render_size is not None and whole_number(render_size, "render_size", least=8, unit=" pixels") > 1024:
            raise ValueError(f"render_size must be at most 1024 pixels, got {render_size}.")
        self.env = make(domain, num_envs, **options)
        self.num_envs, self._render_size = self.env.batch_size[0], render_size
        pixels, action = self.env.observation_spec["pixels"], self.env.action_spec.space
        channels, height, width = pixels.shape[-3:]
        self.observation_space = spaces.Box(0, 255, (height, width, channels), np.uint8)
        self._low, self._side = action.low[0].cpu().numpy(), (action.high - action.low)[0].cpu().numpy()
        self.action_space = spaces.Box(-1.0, 1.0, self._low.shape, np.float32)
        self.seen: TensorDictBase = TensorDict()
        self.limit = row_of(domain).default_horizon()

    def check_started(self, what: str) -> None:
        """Raise before the first reset."""
        if self.seen.is_empty():
            raise ResetNeeded(f"{what} was called before the first reset. Call reset() first.")

    def reset(self, mask: np.ndarray | None = None) -> np.ndarray:
        """Start episodes, of all environments or of those in the mask ``[N]``."""
        request = None
        if mask is not None:
            self.check_started("reset with a mask")
            request = self.seen.copy().set("_reset", torch.as_tensor(mask)[:, None].to(self.env.device))
        self.seen = self.env.reset(request)
        return _images(self.seen["pixels"])

    def checked(self, action: Any, *lead: int, unused: np.ndarray | None = None) -> np.ndarray:
        """The action in float32, 0 in unused rows; an error in Gymnasium's terms for another shape, type or range."""
        shape = (*lead, *self._low.shape)
        try:
            found = np.asarray(action)
        except Exception as error:
            raise TypeError(f"An action must be an array of shape {shape}, got {action!r}: {error}.") from None
        if found.dtype.kind not in "fiu":
            raise TypeError(f"An action must be an array of numbers of shape {shape}, got dtype {found.dtype}.")
        if found.shape != shape:
            raise ValueError(f"An action must have shape {shape}, got {found.shape}.")
        with np.errstate(over="ignore"):
            own = found.astype(np.float32)
        if unused is not None:
            own[unused] = 0.0
        excess = (np.abs(own) - 1.0) * self._side / 2.0
        if not (excess <= ACTION_TOLERANCE).all():  # also catches NaN
            raise ValueError(
                f"An action lies outside the action space or is not finite: received values from {own.min():.4g} to "
                f"{own.max():.4g}, allowed are -1 to 1, which stand for the domain's own box. "
                "Clip it to the action space."
            )
        return own

    def step(self, actions: np.ndarray) -> TensorDictBase:
        """Act, with checked actions ``[N, A]`` in ±1."""
        own = self._low + self._side * (actions + 1.0) / 2.0
        stepped = self.env.step(self.seen.copy().set("action", torch.as_tensor(own).to(self.env.device)))
        self.seen = stepped["next"].exclude("reward")
        return stepped["next"]

    def flags(self) -> dict[str, np.ndarray]:
        """What ``info`` says of all environments, bool ``[N]``, and the cost, float64 ``[N]``."""
        seen = self.seen
        flags = {key: seen[key].squeeze(-1).cpu().numpy() for key in _FLAGS if key in seen.keys()}  # noqa: SIM118
        return flags | {"cost": flags["constraint"].astype(np.float64)}

    def render(self) -> np.ndarray:
        """The newest frames in colour, ``[N, S, S, 3]``."""
        self.check_started("render")
        env = self.env.base_env
        return _images(env.render_rgb() if self._render_size is None else env.render_frames(self._render_size))

    def say_cut(self, steps: int) -> None:
        """Warn, once, where Gymnasium's limit on steps has ended an episode for which a longer horizon was asked."""
        if self.limit is not None and steps == self.limit < self.env.horizon:
            horizon, limit, self.limit = self.env.horizon, self.limit, None
            warnings.warn(
                f"An episode ended after {limit} steps, the limit of Gymnasium's spec, although horizon={horizon} was "
                f"asked for. Pass max_episode_steps={horizon}, too.",
                stacklevel=3,
            )


def _check_reset_options(options: dict[str, Any] | None, allowed: tuple[str, ...]) -> None:
    for option in options or {}:
        if option not in allowed:
            raise ValueError(
                f"reset has no option {option!r}; it has: {', '.join(allowed) or 'none'}. "
                "Options of the domain, such as start, are given when the environment is made."
            )


class GymEnv(gymnasium.Env):
    """One environment of a domain behind Gymnasium's interface.

    Observations are uint8 images ``[64, 64, C]``, channels last, C = 3 × stacked frames; rewards −1 or 0. ``info`` has
    ``constraint`` and ``success`` (and ``physics_error`` where the domain simulates physics) as NumPy bools without
    dimensions, and ``cost``, 1.0 while the constraint is violated and else 0.0, as in Safety-Gymnasium.

    Actions lie in ±1, which stands for the domain's own box; those of another shape, outside or not finite are refused
    and change nothing. Episodes end by truncation alone; steps after the end stay truncated until a reset.

    Args:
        domain: a name in ``ls3_envs.DOMAINS``.
        render_mode: ``None`` or ``"rgb_array"``.
        render_size: side of rendered frames in pixels, 8 to 1024, for videos; observations stay as they are. As large
            as these when ``None``.
        options: of the domain's environment, e.g. ``horizon=50``.

    Raises:
        ValueError: for another render mode or size, and as the domain does; by ``reset`` for an option, of which it has
            none.
        gymnasium.error.ResetNeeded: by ``step`` and ``render`` before the first ``reset``.

    Example:
        >>> import gymnasium
        >>> import ls3_envs
        >>> env = gymnasium.make("ls3/Navigation-v0", render_mode="rgb_array", render_size=256)
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, bool(info["constraint"]), float(info["cost"]), env.render().shape
        ((64, 64, 3), False, 0.0, (256, 256, 3))
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": _FRAMES_PER_SECOND}  # noqa: RUF012

    def __init__(
        self, domain: str, *, render_mode: str | None = None, render_size: int | None = None, **options: Any
    ) -> None:
        self._batch = _Batch(domain, 1, render_mode, render_size, options)
        self.render_mode = render_mode
        self.observation_space = self._batch.observation_space
        self.action_space = self._batch.action_space
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode; the same seed leads to the same one."""
        _check_reset_options(options, ())
        seed = None if seed is None else checked_seed(seed)
        super().reset(seed=seed)
        if self.spec is not None:  # made by gymnasium.make, which limits the steps
            self._batch.say_cut(self._steps)
        if seed is not None:
            self._batch.env.set_seed(seed)
        image, self._steps = self._batch.reset()[0], 0
        return image, self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Act."""
        self._batch.check_started("step")
        out = self._batch.step(self._batch.checked(action)[None])
        self._steps += 1
        reward, truncated = float(out["reward"]), bool(out["truncated"])
        return _images(out["pixels"])[0], reward, bool(out["terminated"]), truncated, self._info()

    def _info(self) -> dict[str, Any]:
        # Arrays without dimensions: TorchRL asks them for a dtype, and Gymnasium's vectors make arrays of them.
        return {key: value[0] if key == "cost" else np.array(value[0]) for key, value in self._batch.flags().items()}

    def render(self) -> np.ndarray | None:
        """The scene in colour, uint8 ``[64, 64, 3]``, or as large as ``render_size`` says."""
        return self._batch.render()[0] if self.render_mode == "rgb_array" else None


class GymVectorEnv(VectorEnv):
    """N environments of a domain, stepped in one call, behind Gymnasium's vector interface.

    Seeds, masks, infos and new starts are those of Gymnasium's ``SyncVectorEnv``: ``reset(seed=s)`` gives environment
    ``i`` the seed ``s + i``, a list gives each its own (``None``: goes on with its stream), and
    ``reset(options={"reset_mask": mask})`` starts only those in the mask anew. Each goes the way that a :class:`GymEnv`
    goes under the same seed. Every key of ``info`` has its mask, ``_constraint`` beside ``constraint``.

    Args:
        domain: a name in ``ls3_envs.DOMAINS``.
        num_envs: N.
        render_mode: ``None`` or ``"rgb_array"``.
        render_size: side of rendered frames in pixels, as for :class:`GymEnv`.
        autoreset_mode: when one that ended starts anew: at the next step, whose action is not used (``NEXT_STEP``); at
            once, its last image then being in ``info["final_obs"]`` (``SAME_STEP``); or when ``reset`` is called
            (``DISABLED``).
        max_episode_steps: truncate episodes after so many steps, if the domain's horizon has not;
            ``gymnasium.make_vec`` passes the spec's.
        options: of the domain's environment.

    Raises:
        ValueError: for another render mode, size or autoreset mode, and as the domain does; by ``reset`` for seeds or a
            mask of another length, a mask without a True, or another option.
        TypeError: by ``reset`` for a mask that is no NumPy array of bools, or a seed that is no whole number.
        gymnasium.error.ResetNeeded: by ``step``, ``render`` and ``reset`` with a mask before the first ``reset``, and
            by ``step`` after an end where there is no autoreset.

    Example:
        >>> import gymnasium
        >>> import ls3_envs
        >>> envs = gymnasium.make_vec("ls3/Navigation-v0", num_envs=4)
        >>> envs.reset(seed=0)[0].shape
        (4, 64, 64, 3)
        >>> envs.reset(seed=[3, 3, 5, None])[1]["_constraint"]
        array([ True,  True,  True,  True])
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": _FRAMES_PER_SECOND,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        domain: str,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        render_size: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            allowed = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode must be one of {allowed}, got {autoreset_mode!r}.") from None
        self._most_steps = None if max_episode_steps is None else whole_number(max_episode_steps, "max_episode_steps")
        self._batch = _Batch(domain, num_envs, render_mode, render_size, options)
        self.num_envs, self.render_mode = self._batch.num_envs, render_mode
        self.metadata = self.metadata | {"autoreset_mode": self._mode}
        self.single_observation_space = self._batch.observation_space
        self.single_action_space = self._batch.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._ended = np.zeros(self.num_envs, dtype=bool)
        self._steps = np.zeros(self.num_envs, dtype=int)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """Start an episode in every environment, or in those of ``options["reset_mask"]``, bool ``[N]``."""
        _check_reset_options(options, ("reset_mask",))
        mask = None if options is None or "reset_mask" not in options else self._checked_mask(options["reset_mask"])
        seeds = self._checked_seeds(seed)
        if mask is not None:
            self._batch.check_started("reset with a mask")
        super().reset(seed=None if seeds is None or isinstance(seed, list | tuple | np.ndarray) else seeds[0])
        chosen = np.ones(self.num_envs, dtype=bool) if mask is None else mask
        if seeds is not None:
            own = [s if among else None for s, among in zip(seeds, chosen, strict=True)]
            self._batch.env.base_env.set_seeds(own)
        images = self._start(mask)
        return images, self._info(chosen)

    def _start(self, mask: np.ndarray | None) -> np.ndarray:
        images = self._batch.reset(mask)
        rows = slice(None) if mask is None else mask
        self._ended[rows], self._steps[rows] = False, 0
        return images

    def _checked_seeds(self, seed: Any) -> list[int | None] | None:
        if seed is None:
            return None
        if isinstance(seed, list | tuple) or (isinstance(seed, np.ndarray) and seed.ndim == 1):
            if len(seed) != self.num_envs:
                raise ValueError(f"seed must hold {self.num_envs} seeds, one for each environment; got {len(seed)}.")
            return [None if one is None else checked_seed(one, f"seed[{i}]") for i, one in enumerate(seed)]
        first = checked_seed(seed)
        return [first + i for i in range(self.num_envs)]

    def _checked_mask(self, mask: Any) -> np.ndarray:
        allowed = f"options['reset_mask'] must be a NumPy array of {self.num_envs} bools, one for each environment"
        if not isinstance(mask, np.ndarray):
            raise TypeError(f"{allowed}; got {mask!r} of type {type(mask).__name__}.")
        if mask.dtype != np.bool_:
            raise TypeError(f"{allowed}; got dtype {mask.dtype}.")
        if mask.shape != (self.num_envs,):
            raise ValueError(f"{allowed}; got shape {mask.shape}.")
        if not mask.any():
            raise ValueError(f"{allowed}, at least one of them True; got {mask.tolist()}.")
        return mask.copy()

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Act in every environment; those that ended start anew as ``autoreset_mode`` says."""
        self._batch.check_started("step")
        anew = self._ended.copy()
        if self._mode == AutoresetMode.DISABLED and anew.any():
            raise ResetNeeded(
                f"The environments {anew.nonzero()[0].tolist()} have ended, and autoreset is disabled. "
                "Call reset(options={'reset_mask': terminated | truncated}) first."
            )
        actions = self._batch.checked(actions, self.num_envs, unused=anew)
        everybody = np.ones(self.num_envs, dtype=bool)
        if anew.all():
            nothing = np.zeros(self.num_envs, dtype=bool)
            return self._start(None), np.zeros(self.num_envs), nothing, nothing.copy(), self._info(everybody)
        out = self._batch.step(actions)
        self._steps += 1
        reward, terminated, truncated = (
            out[key].squeeze(-1).cpu().numpy().copy() for key in ("reward", "terminated", "truncated")
        )
        images = _images(out["pixels"])
        if self._most_steps is not None:
            cut = (self._steps >= self._most_steps) & ~anew
            truncated |= cut
            if cut.any():
                self._batch.say_cut(self._most_steps)
        if anew.any():
            images = self._start(anew)
            reward[anew], terminated[anew], truncated[anew] = 0.0, False, False
        self._ended = terminated | truncated
        info: dict[str, Any] = {}
        if self._mode == AutoresetMode.SAME_STEP and self._ended.any():
            ended = self._ended.copy()
            info = self._last(images, ended)
            images = self._start(ended)
        return images, reward.astype(np.float64), terminated, truncated, info | self._info(everybody)

    def _last(self, images: np.ndarray, ended: np.ndarray) -> dict[str, Any]:
        last = np.full(self.num_envs, None, dtype=object)
        for i in ended.nonzero()[0]:
            last[i] = images[i]
        return {
            "final_obs": last,
            "_final_obs": ended,
            "final_info": self._info(ended),
            "_final_info": ended.copy(),
        }

    def _info(self, rows: np.ndarray) -> dict[str, Any]:
        """What ``info`` says of some environments: 0 for the others, which its masks tell apart."""
        info: dict[str, Any] = {}
        for key, value in self._batch.flags().items():
            info |= {key: np.where(rows, value, np.zeros_like(value)), f"_{key}": rows.copy()}
        return info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The scenes in colour, uint8 ``[64, 64, 3]`` each, or as large as ``render_size`` says."""
        return tuple(self._batch.render()) if self.render_mode == "rgb_array" else None
