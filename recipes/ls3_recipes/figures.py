"""Figures of episodes: return, success and violation, one by one and over all of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import LazyStackedTensorDict, TensorDictBase

Figures = dict[str, torch.Tensor]


def as_one_shape(episodes: TensorDictBase) -> TensorDictBase:
    """Episodes ``[N, T]`` as they are, and those of different lengths as one of all their steps, ``[1, T_1 + …]``."""
    if not isinstance(episodes, LazyStackedTensorDict) or len({len(row) for row in episodes.tensordicts}) == 1:
        return episodes
    return torch.cat([row.to_tensordict() for row in episodes.tensordicts])[None]


def episode_figures(episodes: TensorDictBase) -> Figures:
    """Return, success and violation of each episode of ``[N, T]``, or of different lengths; each ``[N]``."""
    if as_one_shape(episodes) is not episodes:
        each = [episode_figures(row[None]) for row in episodes.unbind(0)]
        return {name: torch.cat([figures[name] for figures in each]) for name in each[0]}
    return {
        "return": episodes["next", "reward"].sum((-1, -2)),
        "success": episodes["next", "success"].any(-2).squeeze(-1),
        "violation": episodes["next", "constraint"].any(-2).squeeze(-1),
    }


def means_of(figures: Figures) -> dict[str, float]:
    """Their means, as the metrics have them."""
    return {f"mean_{name}": float(value.float().mean()) for name, value in figures.items()}


def summarise(figures: Sequence[Figures]) -> dict[str, float | int]:
    """Rates and returns over all episodes, as ``summary.json`` has them."""
    merged = {name: torch.cat([part[name] for part in figures]).float() for name in figures[0]}
    returns = merged["return"]
    return {
        "success_rate": round(float(merged["success"].mean()), 4),
        "violation_rate": round(float(merged["violation"].mean()), 4),
        "return_mean": round(float(returns.mean()), 3),
        "return_std": round(float(returns.std(correction=0)), 3),
        "episodes": len(returns),
    }


def best_update(online: Sequence[Figures]) -> int:
    """Number of the update whose episodes violated least and, among those, returned most; the later of equals."""
    ranks = [
        (-float(figures["violation"].float().mean()), float(figures["return"].float().mean()), update)
        for update, figures in enumerate(online)
    ]
    return max(ranks)[-1]
