"""A companion of equation (1): latents that dynamics can predict (Watter et al., 2015)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ls3_torchrl.modules.call import encode
from ls3_torchrl.objectives.base import LatentLoss


class LatentPredictionLoss(LatentLoss):
    """J(θ) = ‖μ(s_{t+1}) − f_dyn(μ(s_t), a_t)‖², with μ the mean of f_enc, averaged over batch, members and dimensions.

    Added to :class:`VAELoss`, it teaches the encoder and a dynamics model together. A VAE alone is content with any
    latents that tell images apart, and folds the few things that move into many dimensions; what the dynamics learn at
    one place then holds nowhere else. Not part of the paper, which trains the VAE by itself.

    What a single image hardly shows, such as speed, shows several steps later: with K actions between the images, every
    member of the dynamics is unrolled over them from its own means.

    The error shrinks with the latents' scale, which equation (1)'s KL term only partly holds up:
    :meth:`~ls3_torchrl.modules.PixelEncoder.rescale` gives them a unit scale again.

    Args:
        encoder: any module of one observation that writes ``loc`` or ``latent``; gets gradients through both images.
        dynamics: :class:`~ls3_torchrl.modules.EnsembleDynamics`, of which every member learns from every row; or any
            module of latent and action whose first output is the next latent.

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

    encoder: TensorDictModuleBase
    dynamics: TensorDictModuleBase

    def __init__(self, encoder: TensorDictModuleBase, dynamics: TensorDictModuleBase) -> None:
        super().__init__()
        self.out_keys = ["loss_prediction"]
        self.encoder, self.dynamics = encoder, dynamics

    def _predicted(self, latent: Tensor, actions: Tensor) -> Tensor:
        """Every member's latent after the actions ``[B, K, A]``, ``[B, M or 1, D]``."""
        if hasattr(self.dynamics, "unroll"):
            return self.dynamics.unroll(latent, actions)[0][..., -1, :]
        latent_key, action_key = self.dynamics.in_keys[:2]
        for action in actions.unbind(-2):
            step = TensorDict({latent_key: latent, action_key: action}, batch_size=latent.shape[:1])
            latent = self.dynamics(step).get(self.dynamics.out_keys[0])
        return latent.unsqueeze(-2)

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The loss on images ``[B, C, 64, 64]`` and the action, or the K actions ``[B, K, A]``, between them."""
        pixels, actions, next_pixels = (tensordict.get(key) for key in self.in_keys)
        both = torch.cat([pixels, next_pixels])
        rows = TensorDict({self.encoder.in_keys[0]: both}, batch_size=both.shape[:1])
        latent, next_latent = encode(self.encoder, rows)[0].chunk(2)
        return self.of_latents(latent, actions, next_latent)

    def of_latents(self, latent: Tensor, actions: Tensor, next_latent: Tensor) -> dict[str, Tensor]:
        """The loss of images that are encoded already, to ``[B, D]``, and the actions between them."""
        if actions.ndim == latent.ndim:
            actions = actions.unsqueeze(-2)
        predicted = self._predicted(latent, actions)
        return {"loss_prediction": (predicted - next_latent.unsqueeze(-2)).square().mean()}
