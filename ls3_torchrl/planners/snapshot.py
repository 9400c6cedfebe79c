"""Copies of the networks' layers, taken anew when a parameter changes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, cast

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from ls3_torchrl._memory import keep_freed_memory
from ls3_torchrl.layers import (
    Layers,
    fastest_precision,
    layers_of,
    members_of,
    stacked_of,
)
from ls3_torchrl.modules.dynamics import EnsembleDynamics
from ls3_torchrl.options.planner import Precision
from ls3_torchrl.planners.latent_env import LatentEnv


class Snapshot:
    """Copies of the layers of five networks, made anew whenever a parameter has changed.

    Args:
        env: holds dynamics, constraint and goal estimator.
        value: V.
        safe_set: f_S.
        precision: ``"fp32"``, ``"bf16"``, or ``"auto"`` for what a short measurement finds faster here.

    Attributes:
        dtype: of the layers.
        members: the dynamics, one member after another. The last layer of control-affine ones writes A's columns one
            after another, not its rows: ``[A, D]`` numbers that are multiplied by the actions and summed fast.
        stacked: the same in weights ``[M, in, out]`` and biases ``[M, 1, out]``.
        value: V, one member after another.
        stacked_value: the same, stacked.
        heads: constraint, goal and safe set.
    """

    def __init__(
        self, env: LatentEnv, value: TensorDictModuleBase, safe_set: TensorDictModuleBase, precision: Precision
    ) -> None:
        self._env, self._value, self._safe_set, self._precision = env, value, safe_set, precision
        self._forget()

    def _forget(self) -> None:
        self.dtype = torch.float32
        self.members: list[Layers] = []
        self.stacked: Layers = []
        self.value: list[Layers] = []
        self.stacked_value: Layers = []
        self.heads: dict[str, Layers] = {}
        self._seen: list[Tensor] = []

    def __getstate__(self) -> dict[str, Any]:
        """The networks, without the copies: those are made anew where they are needed."""
        empty = Snapshot(self._env, self._value, self._safe_set, self._precision)
        return dict(vars(empty))

    @property
    def _heads(self) -> dict[str, nn.Module]:
        return {"constraint": self._env.constraint, "goal": self._env.goal, "safe_set": self._safe_set}

    def _require_finite(self) -> None:
        """Refuse weights that are not finite: the fused layers' ReLU makes a plausible 0 of NaN."""
        modules = {"dynamics": self._env.dynamics, "value": self._value, **self._heads}
        for name, module in modules.items():
            if not torch.stack([p.detach().float().sum() for p in module.parameters()]).isfinite().all():
                raise FloatingPointError(
                    f"Weights of {name} are not finite, so no plan can be judged. Load weights from before its "
                    "training diverged."
                )

    def _parameters(self) -> Iterable[Tensor]:
        for module in (self._env.dynamics, self._env.constraint, self._env.goal, self._value, self._safe_set):
            yield from module.parameters()
            yield from module.buffers()

    def refresh(self) -> bool:
        """Copy the layers anew if a parameter changed; return whether it had.

        Raises:
            FloatingPointError: for weights that are not finite.
        """
        # Values are compared: fused optimisers change parameters without raising their version counter.
        parameters = list(self._parameters())
        if len(parameters) == len(self._seen) and all(map(_same, parameters, self._seen)):
            return False
        self._require_finite()
        device = parameters[0].device
        if device.type == "cpu":
            keep_freed_memory()
        chosen = fastest_precision(device.type) if self._precision == "auto" else self._precision
        self.dtype = torch.bfloat16 if chosen == "bf16" else torch.float32
        columns = _output_columns(cast(EnsembleDynamics, self._env.dynamics)).to(device)
        self.stacked = stacked_of(self._env.dynamics.network, self.dtype)
        weight, bias = self.stacked[-1]
        self.stacked[-1] = weight.index_select(-1, columns), bias.index_select(-1, columns)
        self.members = members_of(self.stacked)
        self.stacked_value = stacked_of(self._value.network, self.dtype)
        self.value = members_of(self.stacked_value)
        self.heads = {name: layers_of(cast(nn.Module, head.network), self.dtype) for name, head in self._heads.items()}
        self._seen = [p.detach().clone() for p in parameters]
        return True


def _output_columns(dynamics: EnsembleDynamics) -> Tensor:
    """The order in which the dynamics' outputs are kept: of b, log σ and A ``[D, A]``, A's columns before its rows."""
    total = dynamics.network.weights[-1].shape[-1]
    if not dynamics.control_affine:
        return torch.arange(total)
    first = 2 * dynamics.latent_dim
    gain = torch.arange(first, total).reshape(dynamics.latent_dim, dynamics.action_dim)
    return torch.cat([torch.arange(first), gain.T.flatten()])


def _same(one: Tensor, other: Tensor) -> bool:
    return (one.device, one.dtype) == (other.device, other.dtype) and torch.equal(one, other)
