"""What the latents know, and how well the dynamics carry it on: the simulator's state, read back from latents."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.modules import MLP

from ls3_torchrl.agent import LS3Agent
from ls3_torchrl.data import EpisodeKeys
from ls3_torchrl.modules.call import encode
from ls3_torchrl.trainers.progress import progress_bar
from ls3_torchrl.trainers.steps import threads

_BATCH, _LR = 256, 3e-3


class StateProbe:
    """Reads the simulator's state from latents: a small network on the posteriors' means of episodes' frames.

    It learns from four fifths of the frames, drawn at random; ``error`` is its mean distance from the true state on
    the rest, in units of the state. Nothing that LS³ learns sees it.

    Args:
        agent: with a trained encoder.
        episodes: ``[N, T]`` each, with observations and states.
        frames: at most so many are used.
        steps: gradient steps.
        keys: where episodes hold observations and actions.
        state_key: where they hold the state ``[N, T, S]``.
        progress: show a progress bar.

    Raises:
        KeyError: where episodes keep no state.
    """

    def __init__(
        self,
        agent: LS3Agent,
        episodes: Iterable[TensorDictBase],
        *,
        frames: int = 10_000,
        steps: int = 3000,
        keys: EpisodeKeys | None = None,
        state_key: NestedKey = "state",
        progress: bool = True,
    ) -> None:
        self.agent, self.keys, self.state_key = agent, keys or EpisodeKeys(), state_key
        episodes = list(episodes)
        seen, state = (torch.cat([e[k].flatten(0, 1) for e in episodes]) for k in (self.keys.observation, state_key))
        generator = torch.Generator().manual_seed(0)
        chosen = torch.randperm(len(seen), generator=generator)[:frames]
        latent, state = self.encode(seen[chosen]), state[chosen].float().cpu()
        test, train = slice(0, len(chosen) // 5), slice(len(chosen) // 5, None)
        self._latent = latent.mean(0), latent.std(0).clamp(min=1e-6)
        self._state = state.mean(0), state.std()
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self._network = MLP(latent.shape[1], state.shape[1], num_cells=[128, 128], activation_class=nn.ReLU)
        self._fit(latent[train], state[train], steps, generator, progress)
        self.error = float((self.read(latent[test]) - state[test]).norm(dim=-1).mean())

    def _fit(self, latent: Tensor, state: Tensor, steps: int, generator: torch.Generator, progress: bool) -> None:
        optimizer = torch.optim.Adam(self._network.parameters(), lr=_LR, fused=True)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _LR, total_steps=steps, pct_start=0.05)
        seen = (latent - self._latent[0]) / self._latent[1]
        target = (state - self._state[0]) / self._state[1]
        with threads(1), progress_bar(steps, "Probe", enabled=progress) as bar:
            for _ in range(steps):
                rows = torch.randint(len(latent), (_BATCH,), generator=generator)
                loss = (self._network(seen[rows]) - target[rows]).square().mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                schedule.step()
                bar.update()

    @torch.no_grad()
    def encode(self, observations: Tensor) -> Tensor:
        """Posterior means ``[n, D]`` of observations ``[n, …]``."""
        device = next(self.agent.parameters()).device
        key = self.agent.encoder.in_keys[0]
        parts = (encode(self.agent.encoder, TensorDict({key: p.to(device)}, [len(p)])) for p in observations.split(512))
        return torch.cat([loc.cpu() for loc, _ in parts])

    @torch.no_grad()
    def read(self, latent: Tensor) -> Tensor:
        """States ``[n, S]`` of latents ``[n, D]``."""
        return self._network((latent - self._latent[0]) / self._latent[1]) * self._state[1] + self._state[0]

    @torch.no_grad()
    def imagination_error(self, episodes: TensorDictBase, *, horizon: int, stride: int = 5) -> float:
        """Mean distance, in units of the state, between where an agent was and where it imagined to be.

        From every ``stride``-th step of the episodes, the mean of the dynamics ensemble is unrolled for ``horizon``
        steps with the actions that were taken.

        Args:
            episodes: ``[N, T]`` with observations, actions and next states.
            horizon: H, imagined steps.
            stride: between starts.

        Raises:
            ValueError: for episodes of fewer steps than H.
        """
        if episodes.shape[1] < horizon:
            raise ValueError(f"Episodes of {episodes.shape[1]} steps are too short to imagine {horizon} of them.")
        dynamics = self.agent.dynamics
        device = next(self.agent.parameters()).device
        starts = torch.arange(0, episodes.shape[1] - horizon + 1, stride)
        latent = self.encode(episodes[self.keys.observation][:, starts].flatten(0, 1)).to(device)
        for step in range(horizon):
            action = episodes[self.keys.action][:, starts + step].flatten(0, 1).to(device)
            predicted = dynamics.distribution(latent, action)[0]
            latent = predicted.mean(-2) if predicted.ndim > latent.ndim else predicted
        reached = episodes[unravel_key(("next", self.state_key))][:, starts + horizon - 1].flatten(0, 1).cpu()
        return float((self.read(latent.cpu()) - reached).norm(dim=-1).mean())
