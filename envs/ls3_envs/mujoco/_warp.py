"""MuJoCo Warp, imported quietly and only when it is needed: the import takes a second."""

import torch
import warp as wp

wp.config.log_level = wp.LOG_ERROR  # otherwise it greets, names every kernel, and warns where there is no GPU

import mujoco_warp as mjw  # noqa: E402

wp.init()

__all__ = ["mjw", "wp", "wp_device"]


def wp_device(device: torch.device) -> str:
    """Warp's name of a PyTorch device."""
    return str(wp.device_from_torch(device))
