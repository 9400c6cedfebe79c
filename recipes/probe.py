"""What the latents know, and how well the dynamics carry it on: the simulator's state, read back from latents."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag


def kernel_ridge(x: Tensor, y: Tensor, *, ridge: float = 1e-5) -> tuple[Tensor, Tensor, float]:
    """Fit y ≈ k(·, x) w + mean(y) with a Gaussian kernel half as wide as the median distance between inputs.

    Args:
        x: inputs ``[n, D]``.
        y: targets ``[n, S]``.
        ridge: added to the kernel's diagonal.

    Returns:
        Weights ``[n, S]``, offset ``[S]`` and the kernel's width.
    """
    distance = torch.cdist(x, x)
    width = 0.5 * float(distance[torch.triu(torch.ones_like(distance, dtype=torch.bool), 1)].median())
    kernel = (-0.5 * (distance / width).square()).exp()
    offset = y.mean(0)
    weights = torch.linalg.solve(kernel + ridge * torch.eye(len(x), dtype=x.dtype), y - offset)
    return weights, offset, width


class StateProbe:
    """Reads the simulator's state from latents: kernel ridge regression on the posteriors' means of offline frames.

    It learns from four fifths of the frames, drawn at random; ``error`` is its mean distance from the true state on
    the rest, in units of the state.

    Args:
        agent: with a trained encoder.
        offline: episodes ``[N, T]`` by tag, with ``state``.
        frames: at most so many are used.

    Raises:
        KeyError: where episodes keep no ``state``.
    """

    @torch.no_grad()
    def __init__(self, agent: LS3Agent, offline: dict[Tag, TensorDictBase], *, frames: int = 4000) -> None:
        self.agent = agent
        pixels, state = (torch.cat([e[k].flatten(0, 1) for e in offline.values()]) for k in ("pixels", "state"))
        chosen = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0))[:frames]
        latent, state = self.encode(pixels[chosen]).double(), state[chosen].double()
        test, train = slice(0, len(chosen) // 5), slice(len(chosen) // 5, None)
        self._seen = latent[train]
        self._weights, self._offset, self._width = kernel_ridge(self._seen, state[train])
        self.error = float((self.read(latent[test]) - state[test]).norm(dim=-1).mean())

    def encode(self, pixels: Tensor) -> Tensor:
        """Posterior means ``[n, D]`` of images ``[n, C, 64, 64]``."""
        device = next(self.agent.parameters()).device
        parts = (self.agent.encoder[0](TensorDict({"pixels": p.to(device)}, [len(p)])) for p in pixels.split(512))
        return torch.cat([part["loc"].cpu() for part in parts])

    def read(self, latent: Tensor) -> Tensor:
        """States ``[n, S]`` of latents ``[n, D]``."""
        distance = torch.cdist(latent.double(), self._seen)
        return (-0.5 * (distance / self._width).square()).exp() @ self._weights + self._offset

    @torch.no_grad()
    def imagination_error(self, episodes: TensorDictBase, *, horizon: int, stride: int = 5) -> float:
        """Mean distance, in units of the state, between where an agent was and where it imagined to be.

        From every ``stride``-th step of the episodes, the mean of the dynamics ensemble is carried on for ``horizon``
        steps with the actions that were taken.

        Args:
            episodes: ``[N, T]`` with ``pixels``, ``action`` and ``("next", "state")``.
            horizon: H, imagined steps.
            stride: between starts.
        """
        dynamics = self.agent.dynamics
        device = next(self.agent.parameters()).device
        starts = torch.arange(0, episodes.shape[1] - horizon + 1, stride)
        latent = self.encode(episodes["pixels"][:, starts].flatten(0, 1)).to(device)
        for step in range(horizon):
            action = episodes["action"][:, starts + step].flatten(0, 1).to(device)
            latent = dynamics.distribution(latent, action)[0].mean(-2)
        reached = episodes["next", "state"][:, starts + horizon - 1].flatten(0, 1)
        return float((self.read(latent.cpu()) - reached).norm(dim=-1).mean())
