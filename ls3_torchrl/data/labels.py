"""Labels of a trajectory, computed backwards over time."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.objectives.value.functional import reward2go


def reward_to_go(reward: Tensor, gamma: float) -> Tensor:
    """Σ_{i≥0} γ^i r_{t+i} up to the trajectory's end (the target of equation (3)).

    Args:
        reward: ``[*B, T, 1]``.
        gamma: γ in [0, 1].

    Returns:
        ``[*B, T, 1]``.

    Example:
        >>> reward_to_go(torch.tensor([[-1.0], [-1.0], [0.0]]), gamma=0.5).flatten().tolist()
        [-1.5, -1.0, 0.0]
    """
    if gamma == 0.0:  # reward2go's filter would be empty
        return reward.clone()
    end = torch.zeros_like(reward, dtype=torch.bool)
    end[..., -1, :] = True
    return reward2go(reward, end, gamma).reshape(reward.shape)


def timed_out(success: Tensor, constraint: Tensor) -> Tensor:
    """Whether a trajectory neither reaches the goal nor violates a constraint: it tells of no state that it is unsafe.

    Args:
        success: bool ``[*B, T, 1]``.
        constraint: bool ``[*B, T, 1]``, whether the step's next state violates.

    Returns:
        bool ``[*B, T, 1]``, alike for all steps of a trajectory.

    Example:
        >>> never, late = torch.zeros(3, 1, dtype=torch.bool), torch.tensor([[False], [False], [True]])
        >>> timed_out(never, never).flatten().tolist(), timed_out(never, late).flatten().tolist()
        ([True, True, True], [False, False, False])
    """
    decided = success.any(-2, keepdim=True) | constraint.any(-2, keepdim=True)
    return (~decided).expand_as(success)


def after_violation(constraint: Tensor) -> Tensor:
    """Whether a violation has frozen the world before the step: its action moves nothing.

    Args:
        constraint: bool ``[*B, T, 1]``, whether the step's next state violates.

    Returns:
        bool ``[*B, T, 1]``.

    Example:
        >>> after_violation(torch.tensor([[False], [True], [True]])).flatten().tolist()
        [False, False, True]
    """
    violated = constraint.to(torch.uint8).cummax(dim=-2).values.bool()
    return torch.cat([torch.zeros_like(violated[..., :1, :]), violated[..., :-1, :]], dim=-2)


def in_success(success: Tensor) -> Tensor:
    """1_S(s_t): the trajectory reaches the goal at or after this step (the label of equation (5)).

    Args:
        success: bool ``[*B, T, 1]``, whether the step's next state lies in the goal set.

    Returns:
        bool ``[*B, T, 1]``.

    Example:
        >>> in_success(torch.tensor([[False], [True], [False]])).flatten().tolist()
        [True, True, False]
    """
    reversed_success = success.flip(-2).to(torch.uint8)
    return reversed_success.cummax(dim=-2).values.flip(-2).bool()


def length_without_idle_end(success: Tensor, tail: int) -> int:
    """How many steps of a trajectory are left when only ``tail`` of the successes that it ends with are kept.

    Args:
        success: bool ``[T, 1]``, whether the step's next state lies in the goal set.
        tail: at least 1.

    Example:
        >>> done = torch.tensor([[True], [False], [True], [True], [True]])
        >>> length_without_idle_end(done, tail=1), length_without_idle_end(done, tail=9)
        (3, 5)
    """
    steps = len(success)
    failures = (~success.flatten()).nonzero()
    last = int(failures[-1]) + 1 if len(failures) else 0
    return min(last + tail, steps)
