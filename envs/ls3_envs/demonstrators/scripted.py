"""What all scripted policies share, and how whole episodes are collected with them."""

from __future__ import annotations

import math
from abc import abstractmethod

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase


class Scripted(TensorDictModuleBase):
    """A policy over ``state`` that counts the steps of each environment since its reset (``is_init``).

    Args:
        limit: largest size of an action along each axis.
        noise_std: standard deviation of the noise added to every action.
        seed: of that noise.

    Raises:
        ValueError: for a ``noise_std`` that is negative or not finite.
    """

    in_keys = ["state", "is_init"]  # noqa: RUF012
    out_keys = ["action"]  # noqa: RUF012

    def __init__(self, *, limit: float, noise_std: float, seed: int) -> None:
        super().__init__()
        if noise_std < 0:
            raise ValueError(f"noise_std must not be negative, got {noise_std}.")
        if not math.isfinite(noise_std):
            raise ValueError(f"noise_std must be finite, got {noise_std}.")
        self.limit, self.noise_std = limit, noise_std
        self._generator = torch.Generator().manual_seed(seed)
        self._step: Tensor | None = None
        self._kept: dict[str, Tensor] = {}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the noisy action of every environment."""
        state, is_init = tensordict["state"], tensordict["is_init"]
        if self._step is None or self._step.shape != is_init.shape:
            self._step = torch.zeros_like(is_init, dtype=torch.long)
        self._step = torch.where(is_init, 0, self._step)
        action = self._act(state, self._step, is_init)
        noise = torch.randn(action.shape, generator=self._generator).to(action) * self.noise_std
        self._step = self._step + 1
        return tensordict.set("action", (action + noise).clamp(-self.limit, self.limit))

    @abstractmethod
    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        """Noiseless actions ``[N, A]`` at the steps ``[N, 1]``."""

    def _uniform(self, like: Tensor, size: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        """Uniform numbers ``[N, size]`` from the policy's own stream."""
        return low + (high - low) * torch.rand(len(like), size, generator=self._generator).to(like)

    def _for_the_episode(self, name: str, fresh: Tensor, is_init: Tensor) -> Tensor:
        """What was sampled at the episode's first step, ``[N, size]``."""
        kept = self._kept.get(name)
        kept = fresh if kept is None or kept.shape != fresh.shape else torch.where(is_init, fresh, kept)
        self._kept[name] = kept
        return kept


def collect_episodes(env: EnvBase, policy: TensorDictModuleBase) -> TensorDictBase:
    """One whole episode in every environment: a tensordict ``[N, T]`` with the standard keys.

    Args:
        env: a batched environment whose resets are marked by an ``InitTracker``.
        policy: what acts.

    Returns:
        The episodes, without the low-level ``is_init`` bookkeeping of the next state.
    """
    horizon = env.base_env.horizon if hasattr(env, "base_env") else env.horizon
    with torch.no_grad():
        return env.rollout(horizon, policy, break_when_any_done=False)
