"""How the losses call a network on a latent that lies under a key of their own."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor
from torch.func import functional_call


def call_on_latent(
    network: TensorDictModuleBase, latent: Tensor, *, params: TensorDictParams | None = None, **options: bool
) -> Tensor:
    """The first output of a module of one latent, whatever its keys are called.

    Args:
        network: a module with one in-key; its first out-key is returned.
        latent: ``[*B, D]``.
        params: weights to use instead of the module's own.
        options: passed on to the module.
    """
    entry = TensorDict({network.in_keys[0]: latent}, batch_size=latent.shape[:1])
    if params is None:
        return network(entry, **options).get(network.out_keys[0])
    # Not params.to_module(): it leaves the lagged copies behind as parameters that ask for gradients.
    weights = {key if isinstance(key, str) else ".".join(key): value for key, value in params.items(True, True)}
    return functional_call(network, weights, (entry,), options).get(network.out_keys[0])


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
