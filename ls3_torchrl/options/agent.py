"""The sizes and forms of an agent's networks."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ls3_torchrl._values import require_at_least


@dataclass(frozen=True)
class AgentArchitecture:
    """The sizes and forms of an agent's networks, stored beside its weights; the paper's by default (section 1.1.1).

    Args:
        action_dim: A.
        in_channels: C, 3 × stacked frames.
        latent_dim: D (Table 1: 32).
        num_dynamics: members of the dynamics ensemble.
        num_values: members of the value ensemble.
        dynamics_hidden: hidden layers of f_dyn.
        value_hidden: hidden layers of V.
        classifier_hidden: hidden layers of f_S, f_C and f_G.
        control_affine: the dynamics' change of the latent is affine in the action.
        action_scale: unit of the actions in the dynamics, one number or one for each of A. :class:`LS3Agent` also takes
            ``"box"``, half the range of the actions.
        background: the decoder draws on top of a fixed image.

    Raises:
        ValueError: naming the field, what was received and what is allowed.
    """

    action_dim: int
    in_channels: int = 3
    latent_dim: int = 32
    num_dynamics: int = 5
    num_values: int = 5
    dynamics_hidden: tuple[int, ...] = (128, 128)
    value_hidden: tuple[int, ...] = (256, 256, 256)
    classifier_hidden: tuple[int, ...] = (256, 256, 256)
    control_affine: bool = False
    action_scale: float | tuple[float, ...] = 1.0
    background: bool = False

    def __post_init__(self) -> None:
        # Plain numbers and tuples, whatever NumPy or a configuration gave: a file holds nothing else.
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, plain_of(getattr(self, field.name)))
        for name in ("action_dim", "in_channels", "latent_dim", "num_dynamics", "num_values"):
            require_at_least(getattr(self, name), 1, name)
        for name in ("dynamics_hidden", "value_hidden", "classifier_hidden"):
            object.__setattr__(self, name, tuple(require_at_least(size, 1, name) for size in getattr(self, name)))


def plain_of(value: Any) -> Any:
    """Numbers and tuples of them instead of those of NumPy, PyTorch or a configuration."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    return (
        tuple(plain_of(item) for item in value) if isinstance(value, Sequence) and not isinstance(value, str) else value
    )
