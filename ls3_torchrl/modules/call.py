"""How losses, planners and buffers call any network or encoder, whatever its keys are called."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import InteractionType, TensorDictModuleBase, TensorDictParams, set_interaction_type
from torch import Tensor
from torch.func import functional_call


def call_with_params(
    network: TensorDictModuleBase, params: TensorDictParams, tensordict: TensorDictBase, **options: bool
) -> TensorDictBase:
    """What a module writes with other weights than its own, such as the lagged ones of a target network.

    Args:
        network: the module.
        params: weights and buffers under the names that the module has for them.
        tensordict: what the module reads.
        options: passed on to the module.
    """
    # Not params.to_module(): it leaves the lagged copies behind as parameters that ask for gradients.
    weights = {key if isinstance(key, str) else ".".join(key): value for key, value in params.items(True, True)}
    return functional_call(network, weights, (tensordict,), options)


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
    entry = TensorDict({network.in_keys[0]: latent}, batch_size=latent.shape[:-1])
    if params is None:
        return network(entry, **options).get(network.out_keys[0])
    return call_with_params(network, params, entry, **options).get(network.out_keys[0])


def _last(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]


def posterior_keys(encoder: TensorDictModuleBase) -> tuple[NestedKey, NestedKey | None]:
    """Where an encoder writes the mean of a latent and its standard deviation.

    An encoder names them by ``loc_key`` and ``scale_key``, or writes keys that end in ``loc`` and ``scale``; one that
    writes ``latent``, or a single key of any name, is taken to be certain, without a standard deviation.

    Raises:
        ValueError: for an encoder that writes several keys, none of which is ``loc`` or ``latent``.
    """
    loc, scale = getattr(encoder, "loc_key", None), getattr(encoder, "scale_key", None)
    if loc is not None and scale is not None:
        return loc, scale
    by_name = {_last(key): key for key in encoder.out_keys}
    if "loc" in by_name:
        return by_name["loc"], by_name.get("scale")
    if "latent" in by_name:
        return by_name["latent"], None
    if len(encoder.out_keys) == 1:
        return encoder.out_keys[0], None
    raise ValueError(
        f"An encoder must write 'loc' (and 'scale'), 'latent', or a single key; this one writes {encoder.out_keys}. "
        "Rename its out_keys."
    )


def encode(encoder: TensorDictModuleBase, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation ``[*B, D]`` of the latents that an encoder gives to observations.

    Args:
        encoder: any module from observations to ``loc`` and ``scale``, or to a ``latent`` that it is certain of, whose
            standard deviation is zero; see :func:`posterior_keys`.
        tensordict: holds what the encoder reads; it is left as it is.
    """
    loc_key, scale_key = posterior_keys(encoder)
    with set_interaction_type(InteractionType.DETERMINISTIC):
        out = encoder(tensordict.select(*encoder.in_keys))
    loc = out.get(loc_key)
    return loc, torch.zeros_like(loc) if scale_key is None else out.get(scale_key)
