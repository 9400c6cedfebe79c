"""What several losses share."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor


def check_members(latent: Tensor, num_members: int, who: str) -> None:
    """Raise ``ValueError`` unless ``latent`` is a bootstrap batch ``[B, M, D]``."""
    if latent.ndim < 3 or latent.shape[-2] != num_members:
        raise ValueError(
            f"{who}(bootstrap=True) needs one batch per member: latents of shape [B, {num_members}, D], got "
            f"{list(latent.shape)}. Sample with members={num_members}, or pass bootstrap=False."
        )


def as_scalars(**losses: Tensor) -> TensorDict:
    """Losses as a tensordict without batch dimension, as TorchRL's losses return them."""
    return TensorDict(dict(losses), batch_size=torch.Size([]))
