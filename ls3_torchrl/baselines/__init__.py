"""The comparisons' parts that TorchRL's own losses lack: AWAC's actor, and Recovery RL's critic and switch."""

from ls3_torchrl.baselines.awac import AWACLoss
from ls3_torchrl.baselines.networks import (
    ObservedAction,
    PixelFeatures,
    action_bounds,
    action_value,
    deterministic_actor,
    gaussian_actor,
)
from ls3_torchrl.baselines.recovery import RecoveryPolicy, SafetyCritic, SafetyCriticLoss

__all__ = [
    "AWACLoss",
    "ObservedAction",
    "PixelFeatures",
    "RecoveryPolicy",
    "SafetyCritic",
    "SafetyCriticLoss",
    "action_bounds",
    "action_value",
    "deterministic_actor",
    "gaussian_actor",
]
