"""The domains as Gymnasium environments: ``gymnasium.make("ls3/Reacher-v0")`` and ``gymnasium.make_vec``."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ls3_envs.registry import make

_FRAMES_PER_SECOND = 20


def _images(pixels: Tensor) -> np.ndarray:
    """Channels first to channels last, as Gymnasium's image wrappers expect them."""
    return np.ascontiguousarray(pixels.movedim(-3, -1).cpu().numpy())


class _Batch:
    """A batch of a domain's environments, in NumPy, with the spaces of one."""

    def __init__(self, domain: str, num_envs: int, render_mode: str | None, options: dict[str, Any]) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}.")
        self.env = make(domain, num_envs, **options)
        pixels, action = self.env.observation_spec["pixels"], self.env.action_spec.space
        channels, height, width = pixels.shape[-3:]
        self.observation_space = spaces.Box(0, 255, (height, width, channels), np.uint8)
        self._low, self._side = action.low[0].cpu().numpy(), (action.high - action.low)[0].cpu().numpy()
        self.action_space = spaces.Box(-1.0, 1.0, self._low.shape, np.float32)
        self.seen: TensorDictBase = TensorDict()

    def reset(self, seed: int | None, mask: np.ndarray | None = None) -> np.ndarray:
        """Start episodes, of all environments or of those in the mask ``[N]``."""
        if seed is not None:
            self.env.set_seed(seed)
        request = None
        if mask is not None:
            request = self.seen.set("_reset", torch.as_tensor(mask)[:, None].to(self.env.device))
        self.seen = self.env.reset(request)
        return _images(self.seen["pixels"])

    def step(self, actions: np.ndarray) -> TensorDictBase:
        """Act, with actions ``[N, A]`` in ±1."""
        own = self._low + self._side * (np.asarray(actions, dtype=np.float32) + 1.0) / 2.0
        stepped = self.env.step(self.seen.set("action", torch.as_tensor(own).to(self.env.device)))
        self.seen = stepped["next"].exclude("reward")
        return stepped["next"]

    def render(self) -> np.ndarray:
        """The newest frames in colour, ``[N, S, S, 3]``."""
        return _images(self.env.base_env.render_rgb())


class GymEnv(gymnasium.Env):
    """One environment of a domain behind Gymnasium's interface.

    Observations are uint8 images ``[64, 64, C]``, channels last, C = 3 × stacked frames; rewards −1 or 0;
    ``info["constraint"]`` and ``info["success"]`` are bools. Actions lie in ±1, which stands for the domain's own box.
    Episodes end by truncation alone.

    Args:
        domain: a name in :data:`ls3_envs.DOMAINS`.
        render_mode: ``None`` or ``"rgb_array"``.
        options: of the domain's environment, e.g. ``horizon=50``.

    Raises:
        ValueError: for another render mode, and as the domain does.

    Example:
        >>> import gymnasium
        >>> import ls3_envs
        >>> env = gymnasium.make("ls3/Navigation-v0", render_mode="rgb_array")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, info["constraint"]
        ((64, 64, 3), False)
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": _FRAMES_PER_SECOND}  # noqa: RUF012

    def __init__(self, domain: str, *, render_mode: str | None = None, **options: Any) -> None:
        self._batch = _Batch(domain, 1, render_mode, options)
        self.render_mode = render_mode
        self.observation_space = self._batch.observation_space
        self.action_space = self._batch.action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode; the same seed leads to the same one."""
        super().reset(seed=seed)
        return self._batch.reset(seed)[0], self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Act."""
        out = self._batch.step(np.asarray(action)[None])
        reward, truncated = float(out["reward"]), bool(out["truncated"])
        return _images(out["pixels"])[0], reward, bool(out["terminated"]), truncated, self._info()

    def _info(self) -> dict[str, bool]:
        seen = self._batch.seen
        keys = ("constraint", "success", "physics_error")
        return {key: bool(seen[key]) for key in keys if key in seen.keys()}  # noqa: SIM118

    def render(self) -> np.ndarray | None:
        """The scene in colour, uint8 ``[64, 64, 3]``."""
        return self._batch.render()[0] if self.render_mode == "rgb_array" else None


class GymVectorEnv(VectorEnv):
    """N environments of a domain, stepped in one call, behind Gymnasium's vector interface.

    One that ended starts anew at the next step (``AutoresetMode.NEXT_STEP``), whose action is not used.

    Args:
        domain: a name in :data:`ls3_envs.DOMAINS`.
        num_envs: N.
        render_mode: ``None`` or ``"rgb_array"``.
        options: of the domain's environment.

    Raises:
        ValueError: for another render mode, and as the domain does.

    Example:
        >>> import gymnasium
        >>> import ls3_envs
        >>> envs = gymnasium.make_vec("ls3/Navigation-v0", num_envs=4)
        >>> envs.reset(seed=0)[0].shape
        (4, 64, 64, 3)
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": _FRAMES_PER_SECOND,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(self, domain: str, num_envs: int = 1, *, render_mode: str | None = None, **options: Any) -> None:
        self._batch = _Batch(domain, num_envs, render_mode, options)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space = self._batch.observation_space
        self.single_action_space = self._batch.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended = np.zeros(num_envs, dtype=bool)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode in every environment."""
        super().reset(seed=seed)
        self._ended = np.zeros(self.num_envs, dtype=bool)
        return self._batch.reset(seed), self._info()

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Act in every environment; those that ended at the last step start anew instead."""
        anew = self._ended
        out = self._batch.step(actions)
        reward, terminated, truncated = (
            out[key].squeeze(-1).cpu().numpy().copy() for key in ("reward", "terminated", "truncated")
        )
        images = _images(out["pixels"])
        if anew.any():
            images = self._batch.reset(None, anew)
            reward[anew], terminated[anew], truncated[anew] = 0.0, False, False
        self._ended = terminated | truncated
        return images, reward.astype(np.float64), terminated, truncated, self._info()

    def _info(self) -> dict[str, np.ndarray]:
        seen = self._batch.seen
        keys = ("constraint", "success", "physics_error")
        return {key: seen[key].squeeze(-1).cpu().numpy() for key in keys if key in seen.keys()}  # noqa: SIM118

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The scenes in colour, uint8 ``[64, 64, 3]`` each."""
        return tuple(self._batch.render()) if self.render_mode == "rgb_array" else None
