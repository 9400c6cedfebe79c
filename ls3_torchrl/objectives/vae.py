"""Equation (1): the β-VAE's loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch.distributions import Normal, kl_divergence
from torch.nn.functional import mse_loss
from torchrl.objectives import LossModule

from ls3_torchrl._checks import require_choice, require_keys
from ls3_torchrl.modules.vae import PixelDecoder, PixelEncoder, as_unit_pixels
from ls3_torchrl.objectives._common import as_scalars


class VAELoss(LossModule):
    """J(θ) = ‖f_dec(z) − s‖² + β · KL(f_enc(z|s) ‖ N(0, 1)) with a reparameterised z (equation (1)).

    Args:
        encoder: writes ``loc`` and ``scale`` of the posterior.
        decoder: latents to images.
        beta: β, at least 0 (Table 1: 1e-6).
        reduction: ``"mean"`` averages the squared error over pixels and the KL over latent dimensions, as the
            authors' code does and as Table 1's β is meant; ``"sum"`` is equation (1) to the letter. Both then
            average over the batch.

    Returns:
        Scalars ``loss_vae`` (what to minimise), and detached ``reconstruction`` and ``kl``.

    Raises:
        ValueError: for a negative β or an unknown reduction.
        KeyError: when images are missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import PixelDecoder, PixelEncoder
        >>> loss = VAELoss(PixelEncoder(latent_dim=8), PixelDecoder(latent_dim=8))
        >>> batch = TensorDict({"pixels": torch.zeros(4, 3, 64, 64, dtype=torch.uint8)}, [4])
        >>> loss(batch)["loss_vae"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            pixels (NestedKey): images given to the encoder, perhaps augmented.
            target (NestedKey): images to reconstruct; ``None`` means those under ``pixels``.
        """

        pixels: NestedKey = "pixels"
        target: NestedKey | None = None

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    encoder: PixelEncoder
    decoder: PixelDecoder

    def __init__(
        self,
        encoder: PixelEncoder,
        decoder: PixelDecoder,
        *,
        beta: float = 1e-6,
        reduction: Literal["mean", "sum"] = "mean",
    ) -> None:
        super().__init__()
        if beta < 0:
            raise ValueError(f"beta must not be negative, got {beta}.")
        self.encoder, self.decoder = encoder, decoder
        self.out_keys = ["loss_vae", "reconstruction", "kl"]
        self.beta = beta
        self.reduction = require_choice(reduction, ("mean", "sum"), "reduction")

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys that are read, as ``set_keys`` left them."""
        keys = self.tensor_keys
        return [keys.pixels] if keys.target is None else [keys.pixels, keys.target]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        pass

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss on images ``[B, C, 64, 64]``."""
        keys = self.tensor_keys
        target_key = keys.pixels if keys.target is None else keys.target
        require_keys(tensordict, self.in_keys, "VAELoss")
        pixels = tensordict.get(keys.pixels)
        target = as_unit_pixels(tensordict.get(target_key), pixels.shape[-3])

        params = tensordict.empty()
        # Floats in [0, 1] are as good to the encoder; the same images need not be converted twice.
        params.set(self.encoder.pixels_key, target if target_key == keys.pixels else pixels)
        self.encoder[0](params)
        posterior = Normal(params.get(self.encoder.loc_key), params.get(self.encoder.scale_key))
        params.set(self.decoder.in_keys[0], posterior.rsample())
        reconstruction = self.decoder(params).get(self.decoder.out_keys[0])

        # No clamp on the reconstruction: it would stop the gradient of every pixel that starts below zero.
        kl = kl_divergence(posterior, Normal(torch.zeros_like(posterior.loc), torch.ones_like(posterior.scale)))
        if self.reduction == "mean":
            # Channels last, as the images lie: PyTorch's gradient would come in another order than they.
            error = mse_loss(reconstruction.movedim(-3, -1), target.movedim(-3, -1))
            divergence = kl.mean()
        else:
            error = mse_loss(reconstruction, target, reduction="sum") / kl[..., 0].numel()
            divergence = kl.sum(-1).mean()
        return as_scalars(
            loss_vae=error + self.beta * divergence,
            reconstruction=error.detach(),
            kl=divergence.detach(),
        )
