"""What the planner says of each of its plans, for logs and tests."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor

from ls3_torchrl.planners.optimizer import OptimizerResult

_NAMES = ("feasible", "fallback", "relaxed", "safe_set_threshold", "score", "iterations")


class Decisions:
    """Writes what was decided in a plan, each ``[*B, 1]``.

    ``feasible`` and its opposite ``fallback``; ``relaxed``, whether δ_S was lowered at all; ``safe_set_threshold``, the
    δ_S acted on; ``score`` of the plan, or its fallback ranking; ``iterations`` scored.

    Args:
        plan_key: group that they are written in.
    """

    def __init__(self, plan_key: NestedKey) -> None:
        self.keys = {name: unravel_key((plan_key, name)) for name in _NAMES}

    def write(self, out: TensorDictBase, result: OptimizerResult, threshold: Tensor, batch: torch.Size) -> None:
        """Write the outcome of B rows, with the δ_S ``[B]`` that each acted on, as a batch of shape ``batch``."""
        values = {
            "feasible": ~result.fallback,
            "fallback": result.fallback,
            "relaxed": result.restarts > 0,
            "safe_set_threshold": threshold,
            "score": result.score,
            "iterations": result.iterations,
        }
        for name, key in self.keys.items():
            out.set(key, values[name].reshape(*batch, 1))


def describe_plan(tensordict: TensorDictBase, plan_key: NestedKey = "plan") -> TensorDict:
    """Fractions of steps over a collected batch: how often plans were relaxed, or a fallback.

    Args:
        tensordict: what a rollout with the planner returned.
        plan_key: the planner's group.

    Returns:
        Scalars ``fallback_rate``, ``relaxed_rate`` and ``iterations``.

    Example:
        >>> plan = {"fallback": [[False], [True]], "relaxed": [[True], [True]], "iterations": [[5], [6]]}
        >>> described = describe_plan(TensorDict({"plan": plan}, [2]))
        >>> {name: value.item() for name, value in described.items()}
        {'fallback_rate': 0.5, 'relaxed_rate': 1.0, 'iterations': 5.5}
    """
    plan = tensordict.get(plan_key)
    return TensorDict(
        {
            "fallback_rate": plan["fallback"].float().mean(),
            "relaxed_rate": plan["relaxed"].float().mean(),
            "iterations": plan["iterations"].float().mean(),
        }
    )
