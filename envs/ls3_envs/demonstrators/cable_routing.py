"""Cable routing's demonstrations: well over the obstacle, at random from there, and into it (section 1.3.4)."""

from __future__ import annotations

import torch
from torch import Tensor

from ls3_envs.cable_routing import MAX_STEP, OBSTACLE
from ls3_envs.demonstrators.scripted import Scripted

#: Well over the obstacle, to the right until the cable trails behind well past it, then down until it covers the goal.
#: Straight to the goal the cable's end would come within a pixel of the obstacle.
_WAY = ((-0.13, 0.15), (0.16, 0.15), (0.14, 0.02))


class CableDemonstrator(Scripted):
    """Lifts the grasped end well over the obstacle, moves it to the right past the goal, then lays the cable over it.

    The cable keeps five pixels from the obstacle: what passes it more closely cannot be told from what touches it.

    Args:
        noise_std: standard deviation of the noise on the displacements, in metres.
        seed: seed of that noise.

    Example:
        >>> from torchrl.envs import InitTracker, TransformedEnv
        >>> from ls3_envs import CableRoutingEnv
        >>> env = TransformedEnv(CableRoutingEnv(num_envs=2, seed=0), InitTracker())
        >>> bool(env.rollout(50, CableDemonstrator(seed=0))["next", "success"].any(dim=1).all())
        True
    """

    def __init__(self, *, noise_std: float = 0.004, seed: int = 0) -> None:
        super().__init__(limit=MAX_STEP, noise_std=noise_std, seed=seed)

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        return self._along(state, is_init)

    def _along(self, state: Tensor, is_init: Tensor) -> Tensor:
        """The next displacement along the waypoints, ``[N, 2]``, each coordinate at most 1.5 cm."""
        way = state.new_tensor(_WAY)
        reached = self._for_the_episode("reached", torch.zeros_like(state[:, :1]), is_init)
        place = state[:, :2]
        target = way[reached.long().squeeze(-1)]
        near = (target - place).norm(dim=-1, keepdim=True) < 0.02
        self._kept["reached"] = (reached + near).clamp(max=len(way) - 1)
        return (way[self._kept["reached"].long().squeeze(-1)] - place).clamp(-0.015, 0.015)


class CableWanderer(CableDemonstrator):
    """Demonstrates for a random while, then takes uniform actions: random data.

    Args:
        horizon: steps within which the demonstration is left.
        noise_std: standard deviation of the noise on the demonstration's displacements, in metres.
        seed: seed of everything that is sampled.
    """

    def __init__(self, *, horizon: int = 40, noise_std: float = 0.004, seed: int = 0) -> None:
        super().__init__(noise_std=noise_std, seed=seed)
        self.horizon = horizon

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        leaving = self._for_the_episode("leaving", self._uniform(state, 1, 0.0, self.horizon), is_init)
        return torch.where(step < leaving, self._along(state, is_init), self._leave(state))

    def _leave(self, state: Tensor) -> Tensor:
        return self._uniform(state, 2, -MAX_STEP, MAX_STEP)


class CableViolator(CableWanderer):
    """Demonstrates for a random while, then moves to the obstacle: violating data, which the paper has none of here.

    Uniform actions reach the obstacle too seldom to teach a constraint.
    """

    def _leave(self, state: Tensor) -> Tensor:
        towards = state.new_tensor(OBSTACLE) - state[:, :2]
        return 0.6 * MAX_STEP * towards / towards.norm(dim=-1, keepdim=True).clamp(min=1e-6)
