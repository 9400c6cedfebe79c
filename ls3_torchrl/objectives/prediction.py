"""A companion of equation (1): latents that dynamics can predict (Watter et al., 2015)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.objectives import LossModule

from ls3_torchrl._checks import require_keys
from ls3_torchrl.modules.dynamics import EnsembleDynamics
from ls3_torchrl.modules.vae import PixelEncoder
from ls3_torchrl.objectives._common import as_scalars


class LatentPredictionLoss(LossModule):
    """J(θ) = ‖μ(s_{t+1}) − f_dyn(μ(s_t), a_t)‖², with μ the mean of f_enc, averaged over batch, members and dimensions.

    Added to :class:`VAELoss`, it teaches the encoder and a dynamics model together. A VAE alone is content with any
    latents that tell images apart, and folds the few things that move into many dimensions; what the dynamics learn at
    one place then holds nowhere else. Not part of the paper, which trains the VAE by itself.

    What a single image hardly shows, such as speed, shows several steps later: with K actions between the images, the
    means of the dynamics are carried on over them, each member its own.

    The error shrinks with the latents' scale, which equation (1)'s KL term only partly holds up:
    :meth:`~ls3_torchrl.modules.PixelEncoder.rescale` gives them a unit scale again.

    Args:
        encoder: writes the posterior's ``loc``; gets gradients through both images.
        dynamics: every member learns from every row.

    Returns:
        The scalar ``loss_prediction``.

    Raises:
        KeyError: when a key is missing.

    Source: Watter et al., "Embed to Control: A Locally Linear Latent Dynamics Model for Control from Raw Images",
    whose transition term is a KL divergence; here it is the squared distance of the means.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import EnsembleDynamics, PixelEncoder
        >>> loss = LatentPredictionLoss(PixelEncoder(latent_dim=8), EnsembleDynamics(8, 2, control_affine=True))
        >>> images = torch.zeros(4, 3, 64, 64, dtype=torch.uint8)
        >>> batch = TensorDict({"pixels": images, "action": torch.zeros(4, 2), "next": {"pixels": images}}, [4])
        >>> loss(batch)["loss_prediction"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            pixels (NestedKey): images of s_t.
            action (NestedKey): a_t, or a_t to a_{t+K-1}.
            next_pixels (NestedKey): images of s_{t+1}, or s_{t+K}.
        """

        pixels: NestedKey = "pixels"
        action: NestedKey = "action"
        next_pixels: NestedKey = ("next", "pixels")

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    encoder: PixelEncoder
    dynamics: EnsembleDynamics

    def __init__(self, encoder: PixelEncoder, dynamics: EnsembleDynamics) -> None:
        super().__init__()
        self.out_keys = ["loss_prediction"]
        self.encoder, self.dynamics = encoder, dynamics

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys that are read, as ``set_keys`` left them."""
        keys = self.tensor_keys
        return [keys.pixels, keys.action, keys.next_pixels]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        pass

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss on images ``[B, C, 64, 64]`` and the action, or the K actions ``[B, K, A]``, between them."""
        keys = self.tensor_keys
        require_keys(tensordict, self.in_keys, "LatentPredictionLoss")
        pixels, next_pixels = tensordict.get(keys.pixels), tensordict.get(keys.next_pixels)
        both = tensordict.empty(batch_size=[2 * pixels.shape[0]])
        both.set(self.encoder.pixels_key, torch.cat([pixels, next_pixels]))
        latent, next_latent = self.encoder[0](both).get(self.encoder.loc_key).chunk(2)
        actions = tensordict.get(keys.action)
        if actions.ndim == latent.ndim:
            actions = actions.unsqueeze(-2)
        predicted = self.dynamics.unroll(latent, actions)[0][..., -1, :]
        return as_scalars(loss_prediction=(predicted - next_latent.unsqueeze(-2)).square().mean())
