"""Which way plans are imagined: fast where no module is bypassed, through the environment where one would be."""

from __future__ import annotations

import operator
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torch import nn

from ls3_torchrl.options.planner import EngineName, Precision, SafeSetReduction
from ls3_torchrl.planners.fusable import require_fusable, why_not_fused
from ls3_torchrl.planners.fused import FusedImagination
from ls3_torchrl.planners.imagination import Imagination, RolloutImagination
from ls3_torchrl.planners.latent_env import LatentEnv


class Engine:
    """Chooses between :class:`FusedImagination` and :class:`RolloutImagination`, anew at each request.

    Modules may be exchanged, or hooked, between two plans: :meth:`choose` is told which they are now.

    Args:
        env: the learned model.
        value: V.
        safe_set: f_S.
        name: ``"fused"``, ``"rollout"``, or ``"auto"`` for the first wherever it bypasses no module.
        precision: of the fused one.
        safe_set_reduction: over particles, ``"mean"`` or ``"min"``.

    Raises:
        ValueError: for an unknown choice.
        TypeError: for modules that ``"fused"`` would bypass.
    """

    def __init__(
        self,
        env: LatentEnv,
        value: TensorDictModuleBase,
        safe_set: TensorDictModuleBase,
        name: EngineName = "auto",
        *,
        precision: Precision = "auto",
        safe_set_reduction: SafeSetReduction = "mean",
    ) -> None:
        self.name: EngineName = name
        self._precision: Precision = precision
        self._reductions: dict[str, Any] = {
            "safe_set_reduction": safe_set_reduction,
        }
        self._take(env, value, safe_set)
        if name == "fused":
            require_fusable(*self._modules)

    def _take(self, env: LatentEnv, value: TensorDictModuleBase, safe_set: TensorDictModuleBase) -> None:
        self._modules = env, value, safe_set
        self._parts = _parts(*self._modules)
        self._rollout = RolloutImagination(*self._modules, **self._reductions)
        self._fused: FusedImagination | None = None

    def choose(
        self, modules: tuple[LatentEnv, TensorDictModuleBase, TensorDictModuleBase] | None = None
    ) -> Imagination:
        """What imagines plans with these modules: what did so before, unless one of them is another one now."""
        modules = self._modules if modules is None else modules
        if any(map(operator.is_not, _parts(*modules), self._parts)):
            self._take(*modules)
        if self.name == "rollout":
            return self._rollout
        if self.name == "fused":
            require_fusable(*self._modules)
        elif why_not_fused(*self._modules) is not None:
            return self._rollout
        if self._fused is None:
            self._fused = FusedImagination(*self._modules, precision=self._precision, **self._reductions)
        return self._fused


def _parts(env: LatentEnv, value: nn.Module, safe_set: nn.Module) -> tuple[object, ...]:
    """The modules, and those that the environment calls, by which an exchange is told."""
    return env, value, safe_set, *(getattr(env, name, None) for name in ("dynamics", "constraint", "goal"))
