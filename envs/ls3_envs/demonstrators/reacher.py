"""Reacher's demonstrations: the long way round, into the stay-out disc, and a random swing (section 1.3.2)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ls3_envs.demonstrators.scripted import Scripted
from ls3_envs.reacher import LINK, OBSTACLE, START


class ReacherDemonstrator(Scripted):
    """A proportional controller: stretch the arm to the left, below the disc, then raise it to the goal.

    The shoulder turns first, so that the finger leaves the disc behind before the elbow opens: with both at once it
    would pass at a pixel's distance, too near for anything learnt from pictures to know on which side it is.

    Args:
        noise_std: standard deviation of the noise on the torques.
        seed: seed of that noise.

    Example:
        >>> from torchrl.envs import InitTracker, TransformedEnv
        >>> from ls3_envs import ReacherEnv
        >>> env = TransformedEnv(ReacherEnv(num_envs=2, seed=0), InitTracker())
        >>> episodes = env.rollout(10, ReacherDemonstrator(seed=0))
        >>> bool(episodes["next", "constraint"].any())
        False
    """

    def __init__(self, *, noise_std: float = 0.4, seed: int = 0) -> None:
        super().__init__(limit=1.0, noise_std=noise_std, seed=seed)

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        shoulder = torch.where(step < 40, math.pi, 0.75 * math.pi)
        elbow = torch.where(step < 5, START[1], 0.0)
        target = torch.cat([shoulder, elbow], -1)
        return (target - state[:, :2]).clamp(-1.0, 1.0)


class ReacherViolator(Scripted):
    """A PD controller that steers the finger into the stay-out disc, from random starts.

    Use it with ``ReacherEnv(start="random")``.

    Args:
        noise_std: standard deviation of the noise on the torques.
        seed: seed of that noise.

    Example:
        >>> from torchrl.envs import InitTracker, TransformedEnv
        >>> from ls3_envs import ReacherEnv
        >>> env = TransformedEnv(ReacherEnv(num_envs=4, start="random", seed=0), InitTracker())
        >>> env.rollout(3, ReacherViolator(seed=0)).batch_size
        torch.Size([4, 3])
    """

    def __init__(self, *, noise_std: float = 0.2, seed: int = 0) -> None:
        super().__init__(limit=1.0, noise_std=noise_std, seed=seed)

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        # The disc's centre by the elbow's angle (law of cosines), on the side that the elbow bends to now.
        x, y = OBSTACLE
        reach = math.hypot(x, y)
        angle = math.acos((reach**2 - 2 * LINK**2) / (2 * LINK**2))
        bend = torch.where(state[:, 1:2] < 0, -angle, angle)
        shoulder = math.atan2(y, x) - torch.atan2(bend.sin(), 1 + bend.cos())
        error = torch.cat([shoulder, bend], -1) - state[:, :2]
        error[:, :1] = torch.remainder(error[:, :1] + math.pi, 2 * math.pi) - math.pi  # the nearer way round
        return 1.5 * error - 0.3 * state[:, 2:]


class ReacherWanderer(Scripted):
    """Torques that wander, a' ~ N(a, 0.2): random data from which velocities can be learnt.

    Args:
        noise_std: standard deviation of each step of the torques, √0.2 in the paper.
        seed: seed of the torques.

    Example:
        >>> from torchrl.envs import InitTracker, TransformedEnv
        >>> from ls3_envs import ReacherEnv
        >>> env = TransformedEnv(ReacherEnv(num_envs=4, start="random", seed=0), InitTracker())
        >>> env.rollout(3, ReacherWanderer(seed=0)).batch_size
        torch.Size([4, 3])
    """

    def __init__(self, *, noise_std: float = math.sqrt(0.2), seed: int = 0) -> None:
        super().__init__(limit=1.0, noise_std=0.0, seed=seed)
        self.step_std = noise_std

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        last = self._for_the_episode("torque", torch.zeros_like(state[:, :2]), is_init)
        change = torch.randn(last.shape, generator=self._generator).to(last) * self.step_std
        self._kept["torque"] = (last + change).clamp(-self.limit, self.limit)
        return self._kept["torque"]
