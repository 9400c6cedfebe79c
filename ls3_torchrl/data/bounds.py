"""Whether actions of data lie where those of a domain do."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.data import TensorSpec

#: How far actions may lie outside of their bounds, as a fraction of their range: rounding.
TOLERANCE = 1e-4


def require_within(actions: Tensor, spec: TensorSpec, name: str) -> None:
    """Raise ``ValueError`` for actions ``[*B, A]`` of another size than the spec's, or outside of its bounds.

    Args:
        actions: of the data.
        spec: of one action ``[A]``, or batched.
        name: how to call the data in the message.
    """
    size = spec.shape[-1] if spec.shape else 1
    if actions.shape[-1] != size:
        raise ValueError(
            f"{name}: actions have {actions.shape[-1]} dimensions, but those of the action spec {size}. "
            "Use data of the same actions."
        )
    low, high = getattr(spec.space, "low", None), getattr(spec.space, "high", None)
    if low is None or high is None or actions.numel() == 0:
        return
    low, high = (bound.reshape(-1, size)[0].to(actions.device, torch.float64) for bound in (low, high))
    least, most = (torch.as_tensor(values, dtype=torch.float64) for values in actions.reshape(-1, size).aminmax(dim=0))
    room = TOLERANCE * (high - low)
    outside = ((least < low - room) | (most > high + room)).nonzero().flatten().tolist()
    if outside:
        which = outside[0]
        raise ValueError(
            f"{name}: actions lie outside of their bounds: dimension {which} reaches from {float(least[which]):.4g} to "
            f"{float(most[which]):.4g}, but [{float(low[which]):.4g}, {float(high[which]):.4g}] is allowed. If they "
            "are in other units, rescale them; if the environment clamps them, clamp them alike."
        )
