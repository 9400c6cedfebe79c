"""Posteriors of many observations, by any encoder."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import NestedKey, TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ls3_torchrl._checks import require_keys
from ls3_torchrl.modules.call import encode


def encode_frames(
    encoder: TensorDictModuleBase,
    frames: Tensor,
    *,
    key: NestedKey,
    latent_dim: int,
    progress: Callable[[int, int], None] | None = None,
    chunk: int = 128,
) -> TensorDict:
    """Mean ``loc`` and standard deviation ``scale`` of the latents of observations, without gradients.

    Args:
        encoder: any module from one observation to ``loc`` and ``scale``, or to a ``latent`` that it is certain of;
            see :func:`~ls3_torchrl.modules.call.encode`. One that reads a single key is given the observations under
            it, whatever it is called.
        frames: observations ``[n, ...]``.
        key: what they are called, for an encoder that reads several keys.
        latent_dim: D, which the encoder must write.
        progress: called with (frames done, frames in all).
        chunk: frames encoded at a time; many more leave the caches, and the memory for them is got anew every time.

    Returns:
        ``[n]`` with ``loc`` and ``scale``, float32 ``[n, D]``, on the frames' device.

    Raises:
        ValueError: for latents of another size.
        FloatingPointError: for latents that are not finite.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> identity = TensorDictModule(torch.nn.Identity(), in_keys=["state"], out_keys=["latent"])
        >>> encode_frames(identity, torch.ones(3, 2), key="state", latent_dim=2)["loc"].shape
        torch.Size([3, 2])
    """
    weight = next((value for values in (encoder.parameters(), encoder.buffers()) for value in values), None)
    device = frames.device if weight is None else weight.device
    read = encoder.in_keys[0] if len(encoder.in_keys) == 1 else key
    parts = []
    with torch.no_grad():
        for start in range(0, len(frames), chunk):
            part = frames[start : start + chunk].to(device)
            observations = TensorDict({}, [len(part)]).set(read, part)
            require_keys(observations, encoder.in_keys, "The encoder")
            parts.append(encode(encoder, observations))
            _require_size(parts[-1][0], len(part), latent_dim)
            if not all(torch.isfinite(values).all() for values in parts[-1]):
                raise FloatingPointError(
                    "The encoder writes latents that are not finite. Look at its weights, and train it anew."
                )
            if progress is not None:
                progress(min(start + chunk, len(frames)), len(frames))
    loc, scale = (torch.cat(values).to(frames.device, torch.float32) for values in zip(*parts, strict=True))
    return TensorDict({"loc": loc, "scale": scale}, [len(frames)])


def _require_size(loc: Tensor, count: int, latent_dim: int) -> None:
    if loc.shape[-1] != latent_dim:
        raise ValueError(
            f"The encoder writes latents of size {loc.shape[-1]}, but the buffer was made with "
            f"latent_dim={latent_dim}. Give both the same size."
        )
    if loc.shape != (count, latent_dim):
        raise ValueError(
            f"The encoder must write latents [{count}, {latent_dim}] for {count} observations, got {list(loc.shape)}. "
            "Flatten what it writes to one dimension for each observation."
        )
