"""Devices that there are."""

from __future__ import annotations

import torch


def usable_device(device: torch.device | str) -> torch.device:
    """The device, after a look at whether this machine has it.

    Raises:
        ValueError: for a name that PyTorch does not know, or a device that is not there.
    """
    try:
        found = torch.device(device)
        torch.empty(0, device=found)
    except (TypeError, RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        raise ValueError(
            f"device {device!r} cannot be used here: {reason}. Use device='cpu', or one there is."
        ) from None
    return found
