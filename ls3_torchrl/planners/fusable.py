"""Which modules the fused engine may run from copies of their layers: those that are no more than their layers."""

from __future__ import annotations

from typing import cast

from torch import nn

from ls3_torchrl.layers import is_relu_mlp
from ls3_torchrl.modules.classifiers import LatentClassifier, redefines
from ls3_torchrl.modules.dynamics import EnsembleDynamics
from ls3_torchrl.modules.ensemble import EnsembleMLP
from ls3_torchrl.modules.value import ValueEnsemble
from ls3_torchrl.planners.latent_env import LatentEnv

#: Methods whose work is done from the snapshot: where one of them is overridden, it would be bypassed.
_METHODS: dict[type, tuple[str, ...]] = {
    LatentEnv: ("__call__", "forward", "step", "_step", "reset", "_reset", "rollout", "_observe"),
    EnsembleDynamics: ("__call__", "forward", "network_input", "read_output", "distribution"),
    ValueEnsemble: ("__call__", "forward", "of_latent"),
    LatentClassifier: ("__call__", "forward", "of_latent", "probability"),
}


def why_not_fused(env: nn.Module, value: nn.Module, safe_set: nn.Module) -> str | None:
    """Which module a snapshot of layers would bypass, and why; ``None`` if it is the same as the modules.

    That holds for this library's own modules and for subclasses that override none of the methods concerned, with
    plain ReLU networks and without forward hooks.
    """
    reason = _of_module("model", env, LatentEnv)
    if reason is not None or not isinstance(env, LatentEnv):
        return reason
    if env.world_model is not env.dynamics:
        return "model has a world_model of its own"
    parts: list[tuple[str, nn.Module, type]] = [
        ("dynamics", env.dynamics, EnsembleDynamics),
        ("constraint", env.constraint, LatentClassifier),
        ("goal", env.goal, LatentClassifier),
        ("value", value, ValueEnsemble),
        ("safe_set", safe_set, LatentClassifier),
    ]
    reasons = (_of_module(*part) or _of_network(*part[:2]) for part in parts)
    return next((reason for reason in reasons if reason is not None), None)


def require_fusable(env: nn.Module, value: nn.Module, safe_set: nn.Module) -> None:
    """Raise ``TypeError`` when a snapshot of these modules' layers would bypass one, naming it and the remedy."""
    reason = why_not_fused(env, value, safe_set)
    if reason is not None:
        raise TypeError(
            f"The fused engine would bypass a module: {reason}. It runs the layers of EnsembleDynamics, ValueEnsemble "
            'and classifiers with plain ReLU networks. Use engine="rollout", or "auto", which picks it, for others.'
        )


def _of_module(name: str, module: nn.Module, kind: type) -> str | None:
    what = f"{name} ({type(module).__name__})"
    if not isinstance(module, kind):
        return f"{what} is no {kind.__name__}"
    overridden = [method for method in _METHODS[kind] if redefines(module, kind, method)]
    if overridden:
        return f"{what} overrides {', '.join(overridden)}"
    return f"{what} has forward hooks" if _has_hooks(module) else None


def _of_network(name: str, module: nn.Module) -> str | None:
    network = cast(nn.Module, module.network)
    plain = is_relu_mlp(network) if isinstance(module, LatentClassifier) else type(network) is EnsembleMLP
    if not plain or any("forward" in vars(part) for part in network.modules()):
        kind = type(network).__name__
        return f"{name} ({type(module).__name__}) has a network of another kind than its own, of type {kind}"
    return f"{name}'s network has forward hooks" if any(map(_has_hooks, network.modules())) else None


def _has_hooks(module: nn.Module) -> bool:
    return bool(module._forward_hooks or module._forward_pre_hooks)
