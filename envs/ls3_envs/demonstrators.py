"""Scripted policies that make the offline data: D_success and D_constraint of section 1.3."""

from __future__ import annotations

from abc import abstractmethod

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from ls3_envs.navigation import GOAL, MAX_STEP, START, WALL_HIGH, WALL_LOW


class _Scripted(TensorDictModuleBase):
    """A policy over ``state`` that counts the steps of each world since its reset (``is_init``)."""

    in_keys = ["state", "is_init"]  # noqa: RUF012
    out_keys = ["action"]  # noqa: RUF012

    def __init__(self, *, noise_std: float, seed: int) -> None:
        super().__init__()
        if noise_std < 0:
            raise ValueError(f"noise_std must not be negative, got {noise_std}.")
        self.noise_std = noise_std
        self._generator = torch.Generator().manual_seed(seed)
        self._step: Tensor | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, is_init = tensordict["state"], tensordict["is_init"]
        if self._step is None or self._step.shape != is_init.shape:
            self._step = torch.zeros_like(is_init, dtype=torch.long)
        self._step = torch.where(is_init, 0, self._step)
        action = self._act(state, self._step, is_init)
        noise = torch.randn(action.shape, generator=self._generator).to(action) * self.noise_std
        self._step = self._step + 1
        return tensordict.set("action", (action + noise).clamp(-MAX_STEP, MAX_STEP))

    @abstractmethod
    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        """Noiseless actions ``[N, A]`` at the worlds' steps ``[N, 1]``."""


class NavigationDemonstrator(_Scripted):
    """North for 20 steps, east until step 60, then to the goal: safe, successful and far from optimal.

    Args:
        noise_std: standard deviation of the action noise in window units (a fifth of the action's range).
        seed: seed of that noise.

    Example:
        >>> from torchrl.envs import InitTracker, TransformedEnv
        >>> from ls3_envs import NavigationEnv
        >>> env = TransformedEnv(NavigationEnv(num_worlds=4, seed=0), InitTracker())
        >>> episodes = env.rollout(100, NavigationDemonstrator(seed=0))
        >>> bool(episodes["next", "success"].any(dim=1).all())
        True
    """

    def __init__(self, *, noise_std: float = 2 * MAX_STEP / 5, seed: int = 0) -> None:
        super().__init__(noise_std=noise_std, seed=seed)

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        north = state.new_tensor((START[0], 15.0))
        east = state.new_tensor((GOAL[0], 15.0))
        target = torch.where(step < 20, north, torch.where(step < 60, east, state.new_tensor(GOAL)))
        return (target - state).clamp(-MAX_STEP, MAX_STEP)


class NavigationViolator(_Scripted):
    """15 steps in one random direction, then at half speed to the wall's centre: unsafe examples.

    Use it with ``NavigationEnv(start="random")``.

    Args:
        noise_std: standard deviation of the action noise in window units, the demonstrator's own by default. The
            supplement names none; without it each episode shows the dynamics two actions only.
        seed: seed of directions and noise.

    Example:
        >>> from torchrl.envs import InitTracker, TransformedEnv
        >>> from ls3_envs import NavigationEnv
        >>> env = TransformedEnv(NavigationEnv(num_worlds=4, start="random", seed=0), InitTracker())
        >>> episodes = env.rollout(100, NavigationViolator(seed=0))
        >>> bool(episodes["next", "constraint"][:, -1].all())
        True
    """

    def __init__(self, *, noise_std: float = 2 * MAX_STEP / 5, seed: int = 0) -> None:
        super().__init__(noise_std=noise_std, seed=seed)
        self._direction: Tensor | None = None

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        angle = 2 * torch.pi * torch.rand(is_init.shape, generator=self._generator).to(state)
        fresh = MAX_STEP * torch.cat([angle.cos(), angle.sin()], dim=-1)
        if self._direction is None or self._direction.shape != fresh.shape:
            self._direction = fresh
        self._direction = torch.where(is_init, fresh, self._direction)
        centre = (state.new_tensor(WALL_LOW) + state.new_tensor(WALL_HIGH)) / 2
        towards = centre - state
        towards = 0.5 * MAX_STEP * towards / towards.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        return torch.where(step < 15, self._direction, towards)


def collect_episodes(env: EnvBase, policy: TensorDictModuleBase) -> TensorDictBase:
    """One whole episode in every world: a tensordict ``[N, T]`` with the standard keys.

    Args:
        env: a batched environment whose resets are marked by an ``InitTracker``.
        policy: what acts.

    Returns:
        The episodes, without the low-level ``is_init`` bookkeeping of the next state.
    """
    horizon = env.base_env.horizon if hasattr(env, "base_env") else env.horizon
    with torch.no_grad():
        return env.rollout(horizon, policy, break_when_any_done=False)
