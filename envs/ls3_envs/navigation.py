"""Navigation: a disc in the plane goes round a wall (supplement, section 1.3.1)."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ls3_envs.base import VisualConstraintEnv
from ls3_envs.plane import Circle, Plane, Rectangle

WINDOW = (180.0, 150.0)
START = (30.0, 75.0)
GOAL = (150.0, 75.0)
GOAL_RADIUS = 3.0
WALL_LOW = (75.0, 55.0)
WALL_HIGH = (100.0, 95.0)
DISC_RADIUS = 10.0
MAX_STEP = 3.0
NOISE_STD = 0.125
START_STD = 1.0
HORIZON = 100

_RED = (255.0, 0.0, 0.0)
_BLUE = (0.0, 0.0, 255.0)


class NavigationEnv(VisualConstraintEnv):
    """Single-integrator navigation round a wall, seen as 64×64 images, in pure tensors.

    Dynamics: ``s' = s + a + w`` with ``w ~ N(0, 0.125² I)``, action box ±3 per axis, window 180 × 150 with y
    growing downwards. Start (30, 75) with unit Gaussian noise; goal: the ball of radius 3 about (150, 75);
    wall: the rectangle from (75, 55) to (100, 95), where the disc freezes. The best return is about −40.

    Deviation from the authors' pictures: the disc is drawn over the wall, since otherwise a violating state
    cannot be told from a picture.

    Args:
        num_envs: number N of environments stepped together.
        start: ``"fixed"`` for the paper's start, ``"random"`` for anywhere outside the wall.
        horizon: steps in an episode.
        device: CPU or CUDA device of states and images.
        seed: seed of the environments' random streams.

    Returns:
        From ``step``: the keys of :class:`~ls3_envs.base.VisualConstraintEnv`; ``state`` is the position
        ``[N, 2]`` in window units.

    Raises:
        ValueError: for an unknown ``start``, and as the base class does.

    Example:
        >>> env = NavigationEnv(num_envs=2, seed=0)
        >>> episode = env.rollout(100)
        >>> episode["next", "pixels"].shape
        torch.Size([2, 100, 3, 64, 64])
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        start: Literal["fixed", "random"] = "fixed",
        horizon: int = HORIZON,
        device: torch.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        if start not in ("fixed", "random"):
            raise ValueError(f"start must be 'fixed' or 'random', got {start!r}.")
        super().__init__(
            num_envs=num_envs,
            state_dim=2,
            action_low=(-MAX_STEP, -MAX_STEP),
            action_high=(MAX_STEP, MAX_STEP),
            horizon=horizon,
            device=device,
            seed=seed,
        )
        self.start = start
        # An episode's noise is sampled at reset from each environment's own stream: rows stay independent, steps fast.
        self._noise = torch.zeros(self.num_envs, self.horizon, 2, device=self.device)
        self._canvas = _Canvas(self.image_size, self.device)

    def plane(self, points: int = 60) -> Plane:
        """The window, y downwards, with wall and goal."""
        rows = round(points * WINDOW[1] / WINDOW[0])
        x = (torch.arange(points) + 0.5) * WINDOW[0] / points
        y = (torch.arange(rows) + 0.5) * WINDOW[1] / rows
        return Plane(
            states=torch.stack(torch.meshgrid(x, y, indexing="xy"), -1),
            extent=(0.0, WINDOW[0], WINDOW[1], 0.0),
            outlines=(Rectangle(WALL_LOW, WALL_HIGH), Circle(GOAL, GOAL_RADIUS)),
        )

    def advance_noiseless(self, state: Tensor, action: Tensor) -> Tensor:
        """``s' = s + a``, stopped by the window's edges."""
        return _inside_window(state + action)

    def _initial_state(self, index: int, generator: np.random.Generator) -> Tensor:
        noise = generator.normal(scale=NOISE_STD, size=(self.horizon, 2))
        if self._noise.is_inference():  # made in inference mode, it could not be written to outside
            self._noise = self._noise.clone()
        self._noise[index] = torch.as_tensor(noise, dtype=torch.float32)
        if self.start == "fixed":
            return torch.as_tensor(generator.normal(START, START_STD), dtype=torch.float32)
        while True:
            position = torch.as_tensor(generator.uniform((0.0, 0.0), WINDOW), dtype=torch.float32)
            if not in_wall(position):
                return position

    def _advance(self, state: Tensor, action: Tensor) -> Tensor:
        step = self._clock.clamp(max=self.horizon - 1)
        noise = self._noise[torch.arange(self.num_envs, device=self.device), step]
        return _inside_window(state + action + noise)

    def _violates(self, state: Tensor) -> Tensor:
        return in_wall(state)

    def _succeeds(self, state: Tensor) -> Tensor:
        return (state - state.new_tensor(GOAL)).norm(dim=-1, keepdim=True) <= GOAL_RADIUS

    def _render(self, state: Tensor) -> Tensor:
        return self._canvas.draw(state)

    def render_frames(self, size: int) -> Tensor:
        """All as they are now, drawn at another size: uint8 ``[N, 3, size, size]``."""
        return _Canvas(size, self.device).draw(self._state)


class _Canvas:
    """Pictures of the window with ``size`` pixels a side: wall and disc, with soft edges."""

    def __init__(self, size: int, device: torch.device) -> None:
        centre = (torch.arange(size, device=device) + 0.5) / size
        self.size = size
        self.x, self.y = centre * WINDOW[0], centre * WINDOW[1]

        def coverage(centre: Tensor, low: float, high: float, width: float) -> Tensor:
            covered = (centre + width / 2).clamp(max=high) - (centre - width / 2).clamp(min=low)
            return (covered / width).clamp(0.0, 1.0)

        x = coverage(self.x, WALL_LOW[0], WALL_HIGH[0], WINDOW[0] / size)
        y = coverage(self.y, WALL_LOW[1], WALL_HIGH[1], WINDOW[1] / size)
        blue = torch.tensor(_BLUE, device=device).view(3, 1, 1)
        self.background = blue * (y[:, None] * x[None, :])

    def draw(self, state: Tensor) -> Tensor:
        """Pictures uint8 ``[n, 3, size, size]`` of discs at ``[n, 2]``."""
        dx = self.x - state[:, :1]
        dy = self.y - state[:, 1:]
        distance = (dy[:, :, None].square() + dx[:, None, :].square()).sqrt()
        softness = (WINDOW[0] + WINDOW[1]) / (2 * self.size)  # one pixel: an antialiased edge
        disc = (0.5 + (DISC_RADIUS - distance) / softness).clamp(0.0, 1.0)[:, None]
        red = torch.tensor(_RED, device=state.device).view(1, 3, 1, 1)
        return torch.lerp(self.background.expand(state.shape[0], -1, -1, -1), red, disc).round().to(torch.uint8)


def _inside_window(position: Tensor) -> Tensor:
    return position.clamp(min=0.0).minimum(position.new_tensor(WINDOW))


def in_wall(position: Tensor) -> Tensor:
    """Bool ``[*B, 1]``: the positions ``[*B, 2]`` lie inside the wall."""
    low, high = position.new_tensor(WALL_LOW), position.new_tensor(WALL_HIGH)
    return ((position >= low) & (position <= high)).all(dim=-1, keepdim=True)
