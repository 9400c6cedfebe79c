"""Behaviour cloning: the demonstrations imitated, and nothing learnt from online episodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import nn

from ls3_recipes.algorithms.baseline import Baseline
from ls3_recipes.plots.style import Label
from ls3_torchrl.baselines import deterministic_actor


class BehaviourCloning(Baseline):
    """The floor under every comparison."""

    key = name = "bc"
    labels = {"bc": Label("Behaviour cloning", "#8d99a6")}  # noqa: RUF012

    def build(self, build: Callable[..., Any]) -> dict[str, nn.Module]:
        """An actor without noise."""
        return {"actor": build(deterministic_actor)}
