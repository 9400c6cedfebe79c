"""Figures of episodes: return, success and violation, one by one and over all of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase

Figures = dict[str, torch.Tensor]


def episode_figures(episodes: TensorDictBase) -> Figures:
    """Return, success and violation of each episode of ``[N, T]``; each ``[N]``."""
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
