"""What the latents know: the simulator's state, read back from the posteriors' means."""

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


@torch.no_grad()
def state_error(agent: LS3Agent, offline: dict[Tag, TensorDictBase], *, frames: int = 4000) -> float | None:
    """Mean distance between the true state and what a small probe reads from the latent, in units of the state.

    The probe (kernel ridge regression on posterior means) learns from four fifths of the offline frames, drawn at
    random, and is measured on the rest.

    Args:
        agent: with a trained encoder.
        offline: episodes ``[N, T]`` by tag.
        frames: at most so many are used.

    Returns:
        The error, or ``None`` where the episodes keep no ``state``.
    """
    if any(episodes.get("state", None) is None for episodes in offline.values()):
        return None
    pixels, state = (torch.cat([e[k].flatten(0, 1) for e in offline.values()]) for k in ("pixels", "state"))
    chosen = torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0))[:frames]
    device = next(agent.parameters()).device
    means = [
        agent.encoder[0](TensorDict({"pixels": pixels[part].to(device)}, [len(part)]))["loc"].cpu()
        for part in chosen.split(512)
    ]
    latent, state = torch.cat(means).double(), state[chosen].double()
    test, train = slice(0, len(chosen) // 5), slice(len(chosen) // 5, None)
    weights, offset, width = kernel_ridge(latent[train], state[train])
    guess = (-0.5 * (torch.cdist(latent[test], latent[train]) / width).square()).exp() @ weights + offset
    return float((guess - state[test]).norm(dim=-1).mean())
