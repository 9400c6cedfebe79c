"""Navigation's demonstrations: round the wall, and into it (section 1.3.1)."""

from __future__ import annotations

import torch
from torch import Tensor

from ls3_envs.demonstrators.scripted import Scripted
from ls3_envs.navigation import GOAL, MAX_STEP, START, WALL_HIGH, WALL_LOW


class NavigationDemonstrator(Scripted):
    """North for 20 steps, east until step 60, then to the goal: safe, successful and far from optimal.

    Args:
        noise_std: standard deviation of the action noise in window units (a fifth of the action's range).
        seed: seed of that noise.

    Example:
        >>> from torchrl.envs import InitTracker, TransformedEnv
        >>> from ls3_envs import NavigationEnv
        >>> env = TransformedEnv(NavigationEnv(num_envs=4, seed=0), InitTracker())
        >>> episodes = env.rollout(100, NavigationDemonstrator(seed=0))
        >>> bool(episodes["next", "success"].any(dim=1).all())
        True
    """

    def __init__(self, *, noise_std: float = 2 * MAX_STEP / 5, seed: int = 0) -> None:
        super().__init__(limit=MAX_STEP, noise_std=noise_std, seed=seed)

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        north = state.new_tensor((START[0], 15.0))
        east = state.new_tensor((GOAL[0], 15.0))
        target = torch.where(step < 20, north, torch.where(step < 60, east, state.new_tensor(GOAL)))
        return (target - state).clamp(-MAX_STEP, MAX_STEP)


class NavigationViolator(Scripted):
    """15 steps in one random direction, then at half speed to the wall's centre: unsafe examples.

    Use it with ``NavigationEnv(start="random")``.

    Args:
        noise_std: standard deviation of the action noise in window units, the demonstrator's own by default. The
            supplement names none; without it each episode shows the dynamics two actions only.
        seed: seed of directions and noise.

    Example:
        >>> from torchrl.envs import InitTracker, TransformedEnv
        >>> from ls3_envs import NavigationEnv
        >>> env = TransformedEnv(NavigationEnv(num_envs=4, start="random", seed=0), InitTracker())
        >>> episodes = env.rollout(100, NavigationViolator(seed=0))
        >>> bool(episodes["next", "constraint"][:, -1].all())
        True
    """

    def __init__(self, *, noise_std: float = 2 * MAX_STEP / 5, seed: int = 0) -> None:
        super().__init__(limit=MAX_STEP, noise_std=noise_std, seed=seed)

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        angle = 2 * torch.pi * self._uniform(state, 1)
        direction = self._for_the_episode("direction", MAX_STEP * torch.cat([angle.cos(), angle.sin()], -1), is_init)
        centre = (state.new_tensor(WALL_LOW) + state.new_tensor(WALL_HIGH)) / 2
        towards = centre - state
        towards = 0.5 * MAX_STEP * towards / towards.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        return torch.where(step < 15, direction, towards)
