"""Equation (1): the β-VAE's loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.distributions import Normal
from torch.nn.functional import mse_loss

from ls3_torchrl._checks import require_choice
from ls3_torchrl.modules.call import call_on_latent, encode, posterior_keys
from ls3_torchrl.modules.vae import PixelEncoder, as_unit_pixels
from ls3_torchrl.objectives.base import LatentLoss


class VAELoss(LatentLoss):
    """J(θ) = ‖f_dec(z) − s‖² + β · KL(f_enc(z|s) ‖ N(0, 1)) with a reparameterised z (equation (1)).

    Args:
        encoder: any module of one image that writes ``loc`` and ``scale`` of the posterior.
        decoder: any module of the latent whose first output is the image.
        beta: β, at least 0 (Table 1: 1e-6).
        reduction: ``"mean"`` averages the squared error over pixels and the KL over latent dimensions, as the
            authors' code does and as Table 1's β is meant; ``"sum"`` is equation (1) to the letter. Both then
            average over the batch.

    Returns:
        Scalars ``loss_vae`` (what to minimise), and detached ``reconstruction`` and ``kl``.

    Raises:
        ValueError: for a negative β, an unknown reduction, an encoder without ``scale``, or reconstructions of another
            shape than the images.
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

    encoder: TensorDictModuleBase
    decoder: TensorDictModuleBase

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        decoder: TensorDictModuleBase,
        *,
        beta: float = 1e-6,
        reduction: Literal["mean", "sum"] = "mean",
    ) -> None:
        super().__init__()
        if beta < 0:
            raise ValueError(f"beta must not be negative, got {beta}.")
        if posterior_keys(encoder)[1] is None:
            raise ValueError(
                "VAELoss needs an encoder that writes mean and standard deviation of its posterior, as 'loc' and "
                f"'scale'; {type(encoder).__name__} writes {encoder.out_keys}. Add a standard deviation, or train it "
                "with LatentPredictionLoss, which needs none."
            )
        self.encoder, self.decoder = encoder, decoder
        self.out_keys = ["loss_vae", "reconstruction", "kl"]
        self.beta = beta
        self.reduction = require_choice(reduction, ("mean", "sum"), "reduction")

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The loss on images ``[B, C, 64, 64]``."""
        keys = self.tensor_keys
        pixels = tensordict.get(keys.pixels)
        target = as_unit_pixels(pixels if keys.target is None else tensordict.get(keys.target), self.decoder_dtype)
        if keys.target in (None, keys.pixels) and type(self.encoder) is PixelEncoder:
            # Floats in [0, 1] are as good to it; the same images need not be converted twice.
            pixels = target
        rows = TensorDict({self.encoder.in_keys[0]: pixels}, batch_size=pixels.shape[:1])
        loc, scale = encode(self.encoder, rows)
        return self.of_posterior(loc, scale, target)

    def of_posterior(
        self, loc: Tensor, scale: Tensor, target: Tensor, *, noise: Tensor | None = None
    ) -> dict[str, Tensor]:
        """The loss of images that are encoded already.

        Args:
            loc: mean of q(z|s), ``[B, D]``.
            scale: its standard deviation, ``[B, D]``.
            target: the images, floats in [0, 1] ``[B, C, 64, 64]``.
            noise: standard normal ``[B, D]``, of which z is made; drawn when ``None``.
        """
        latent = Normal(loc, scale).rsample() if noise is None else loc + scale * noise
        reconstruction = call_on_latent(self.decoder, latent)
        if reconstruction.shape != target.shape:
            raise ValueError(
                f"The decoder writes images of shape {list(reconstruction.shape)} where the images to reconstruct have "
                f"shape {list(target.shape)}. Build encoder and decoder for the same images."
            )

        kl = _kl_to_standard_normal(loc, scale)
        # No clamp on the reconstruction: it would stop the gradient of every pixel that starts below zero.
        if self.reduction == "mean":
            if target.ndim > 2:
                # Channels last, as the images lie: PyTorch's gradient would come in another order than they.
                reconstruction, target = reconstruction.movedim(-3, -1), target.movedim(-3, -1)
            error = mse_loss(reconstruction, target)
            divergence = kl.mean()
        else:
            error = mse_loss(reconstruction, target, reduction="sum") / kl[..., 0].numel()
            divergence = kl.sum(-1).mean()
        return {
            "loss_vae": error + self.beta * divergence,
            "reconstruction": error.detach(),
            "kl": divergence.detach(),
        }

    @property
    def decoder_dtype(self) -> torch.dtype:
        """The dtype that the decoder computes in."""
        return next((p.dtype for p in self.decoder.parameters()), torch.float32)


def _kl_to_standard_normal(loc: Tensor, scale: Tensor) -> Tensor:
    """KL(N(loc, scale²) ‖ N(0, 1)) of each dimension.

    ``torch.distributions.kl_divergence`` is not used: the compiler cannot trace how it looks its formula up.
    """
    variance = scale.pow(2)
    return 0.5 * (variance + loc.pow(2) - 1 - variance.log())
