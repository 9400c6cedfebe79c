"""The random streams of a run."""

from __future__ import annotations


def seeds(seed: int) -> dict[str, int]:
    """Seeds of the parts of a run, far apart, so that no two share a random stream."""
    names = ("demonstrations", "online", "evaluation", "learning", "models", "rollouts")
    return {name: 10_000 * seed + 1_000 * i for i, name in enumerate(names)}
