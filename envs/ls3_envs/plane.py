"""What pictures need of a domain whose states can be drawn as points of a plane."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Rectangle(NamedTuple):
    """A rectangle in the plane's coordinates: its corner with the smallest coordinates, and the opposite one."""

    low: tuple[float, float]
    high: tuple[float, float]


class Circle(NamedTuple):
    """A circle in the plane's coordinates."""

    centre: tuple[float, float]
    radius: float


class Plane(NamedTuple):
    """A domain's plane: what maps, paths and plans are drawn on.

    Attributes:
        states: a grid of whole states ``[rows, columns, state_dim]`` that covers the plane, for maps; its first row is
            the picture's top.
        extent: the picture's (left, right, bottom, top) in the plane's coordinates; bottom > top where y grows
            downwards.
        outlines: walls and goals, drawn as lines.
        axes: which two entries of a state are the plane's x and y.

    Example:
        >>> import torch
        >>> y, x = torch.meshgrid(torch.arange(3.0), torch.arange(4.0), indexing="ij")
        >>> moving = torch.stack([torch.zeros(3, 4), x, y], -1)  # states of a speed, x and y
        >>> plane = Plane(moving, (0.0, 3.0, 2.0, 0.0), (Circle((2.0, 1.0), 0.5),), axes=(1, 2))
        >>> plane.positions(moving)[2, 3]
        tensor([3., 2.])
    """

    states: Tensor
    extent: tuple[float, float, float, float]
    outlines: tuple[Rectangle | Circle, ...] = ()
    axes: tuple[int, int] = (0, 1)

    def positions(self, state: Tensor) -> Tensor:
        """Where states ``[*B, state_dim]`` lie in the plane, ``[*B, 2]``."""
        return state[..., list(self.axes)]
