"""The algorithms that a run can train, all under one protocol: one row each."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

from ls3_recipes.algorithms.settings.baselines import AWACSettings, BaselineSettings, SACfDSettings
from ls3_recipes.algorithms.settings.ls3 import LS3Settings
from ls3_recipes.run_settings import RunSettings

if TYPE_CHECKING:
    from ls3_recipes.algorithms.base import Algorithm


@dataclass(frozen=True)
class Row:
    """An algorithm by its address, so that its settings can be shown and checked without PyTorch.

    Args:
        settings_class: the settings that it has; no other is accepted.
        module: the file in this folder.
        name: of the class in it.
    """

    settings_class: type[RunSettings]
    module: str
    name: str

    def load(self) -> type[Algorithm]:
        """The class, imported when it is first asked for."""
        found: type[Algorithm] = getattr(import_module(f"{__name__}.{self.module}"), self.name)
        return found


#: By the names that the configuration knows them by, in the order in which reports show them.
ALGORITHMS = {
    "ls3": Row(LS3Settings, "ls3", "LS3"),
    "sacfd": Row(SACfDSettings, "sacfd", "SACfD"),
    "awac": Row(AWACSettings, "awac", "AWAC"),
    "bc": Row(BaselineSettings, "bc", "BehaviourCloning"),
}

__all__ = ["ALGORITHMS", "Row"]
