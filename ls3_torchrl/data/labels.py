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
