"""Imagining candidate plans fast: a snapshot of the networks, run over blocks that stay in cache."""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import lru_cache
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from ls3_torchrl._checks import require_choice
from ls3_torchrl.modules.classifiers import LatentClassifier
from ls3_torchrl.modules.ensemble import EnsembleMLP
from ls3_torchrl.modules.value import ValueEnsemble
from ls3_torchrl.planners.imagination import ImaginationNoise
from ls3_torchrl.planners.latent_env import LatentEnv
from ls3_torchrl.planners.scoring import ConstraintReduction, PlanStatistics

Precision = Literal["auto", "fp32", "bf16"]
#: A network's layers: weight ``[out, in]`` and bias ``[out]``, ReLU between them.
Layers = list[tuple[Tensor, Tensor]]


def _is_relu_mlp(network: nn.Module) -> bool:
    return isinstance(network, nn.Sequential) and all(
        isinstance(layer, nn.Linear if i % 2 == 0 else nn.ReLU) for i, layer in enumerate(network)
    )


def _layers_of(network: nn.Module, dtype: torch.dtype) -> Layers:
    assert isinstance(network, nn.Sequential)
    return [
        (layer.weight.detach().to(dtype).clone(), layer.bias.detach().to(dtype).clone())
        for layer in network
        if isinstance(layer, nn.Linear)
    ]


def _members_of(network: EnsembleMLP, dtype: torch.dtype) -> list[Layers]:
    return [
        [
            (weight[m].detach().T.to(dtype, copy=True).contiguous(), bias[m, 0].detach().to(dtype).clone())
            for weight, bias in zip(network.weights, network.biases, strict=True)
        ]
        for m in range(network.num_members)
    ]


def _same(one: Tensor, other: Tensor) -> bool:
    return (one.device, one.dtype) == (other.device, other.dtype) and torch.equal(one, other)


@lru_cache(maxsize=1)
def _has_fused_linear() -> bool:
    """Whether PyTorch's private fused bf16 layer is there and right on this machine."""
    x, w, b = (torch.ones(shape, dtype=torch.bfloat16) for shape in ((2, 4), (3, 4), (3,)))
    try:
        out = torch.ops.mkldnn._linear_pointwise(x, w, b, "relu", [], "")
    except (AttributeError, RuntimeError, NotImplementedError):
        return False
    return bool((out == 5).all())


def run_layers(x: Tensor, layers: Layers) -> Tensor:
    """A ReLU network on rows ``[R, in]``, in the layers' own precision."""
    last = len(layers) - 1
    if x.dtype == torch.bfloat16 and x.device.type == "cpu" and _has_fused_linear():
        for i, (weight, bias) in enumerate(layers):
            x = torch.ops.mkldnn._linear_pointwise(x, weight, bias, "relu" if i < last else "none", [], "")
        return x
    for i, (weight, bias) in enumerate(layers):
        x = linear(x, weight, bias)
        if i < last:
            x = x.relu_()
    return x


@lru_cache(maxsize=4)
def fastest_precision(device_type: str) -> Literal["fp32", "bf16"]:
    """Choose by measuring a layer of the heads' size; CUDA takes bf16, other devices what is clearly faster."""
    if device_type != "cpu":
        return "bf16" if device_type == "cuda" and torch.cuda.is_bf16_supported() else "fp32"
    seconds = {}
    for dtype in (torch.float32, torch.bfloat16):
        x = torch.randn(2048, 256).to(dtype)
        layers = [(torch.randn(256, 256).to(dtype), torch.randn(256).to(dtype))] * 3
        run_layers(x, layers)
        times = []
        for _ in range(5):
            start = time.perf_counter()
            run_layers(x, layers)
            times.append(time.perf_counter() - start)
        seconds[dtype] = min(times)
    return "bf16" if seconds[torch.bfloat16] < 0.67 * seconds[torch.float32] else "fp32"


class FusedImagination:
    """The same statistics as :class:`~ls3_torchrl.planners.RolloutImagination`, many times faster.

    It works on a snapshot of the weights, taken anew whenever a parameter has changed since. Particles are
    carried one after another over blocks of candidates: memory grows with N alone. Latents stay float32; the
    layers run in ``precision``.

    Args:
        env: the learned model; its networks must be those of :mod:`ls3_torchrl.modules`.
        value: V.
        safe_set: f_S.
        constraint_reduction: over particles, ``"max"`` or ``"mean"``.
        precision: ``"fp32"``, ``"bf16"``, or ``"auto"`` for what a short measurement finds faster here.
        block: particles of candidates that are carried and judged together.

    Raises:
        ValueError: for an unknown precision.
        TypeError: when a network is not a plain ReLU network.
    """

    def __init__(
        self,
        env: LatentEnv,
        value: ValueEnsemble,
        safe_set: LatentClassifier,
        *,
        constraint_reduction: ConstraintReduction = "max",
        precision: Precision = "auto",
        block: int = 1024,
    ) -> None:
        require_choice(precision, ("auto", "fp32", "bf16"), "precision")
        if not self.supports(env, value, safe_set):
            raise TypeError(
                "FusedImagination needs EnsembleDynamics, ValueEnsemble and classifiers with plain ReLU networks. "
                'Use engine="rollout" for other modules.'
            )
        self.env, self.value, self.safe_set = env, value, safe_set
        self.constraint_reduction = constraint_reduction
        self.precision = precision
        self.block = block
        self._seen: list[Tensor] = []
        self._dynamics: list[Layers] = []
        self._value: list[Layers] = []
        self._heads: dict[str, Layers] = {}

    @staticmethod
    def supports(env: LatentEnv, value: nn.Module, safe_set: nn.Module) -> bool:
        """Whether these modules can be run from a snapshot of their layers."""
        ensembles = all(isinstance(getattr(m, "network", None), EnsembleMLP) for m in (env.dynamics, value))
        heads = (env.constraint, env.goal, safe_set)
        return ensembles and all(_is_relu_mlp(getattr(head, "network", nn.Identity())) for head in heads)

    def _parameters(self) -> Iterable[nn.Parameter]:
        for module in (self.env.dynamics, self.env.constraint, self.env.goal, self.value, self.safe_set):
            yield from module.parameters()

    def refresh(self) -> bool:
        """Take the snapshot anew if a parameter changed; return whether it had."""
        # Values are compared: fused optimisers change parameters without raising their version counter.
        parameters = list(self._parameters())
        if len(parameters) == len(self._seen) and all(map(_same, parameters, self._seen)):
            return False
        device = parameters[0].device
        chosen = fastest_precision(device.type) if self.precision == "auto" else self.precision
        self._dtype = torch.bfloat16 if chosen == "bf16" else torch.float32
        self._dynamics = _members_of(self.env.dynamics.network, self._dtype)
        self._value = _members_of(self.value.network, self._dtype)
        self._heads = {
            name: _layers_of(head.network, self._dtype)
            for name, head in (
                ("constraint", self.env.constraint),
                ("goal", self.env.goal),
                ("safe_set", self.safe_set),
            )
        }
        self._seen = [p.detach().clone() for p in parameters]
        return True

    @torch.no_grad()
    def __call__(self, latent: Tensor, actions: Tensor, noise: ImaginationNoise) -> PlanStatistics:
        """Statistics of ``actions`` ``[b, N, H, A]`` carried out from ``latent`` ``[b, D]``."""
        self.refresh()
        b, n, horizon, _ = actions.shape
        particles = noise.members.shape[1]
        members = noise.members.tolist()
        value = latent.new_zeros(b, n, len(self._value))
        goal = latent.new_zeros(b, n, horizon)
        constraint = latent.new_zeros(b, n, horizon)
        safe = latent.new_zeros(b, n)
        for row in range(b):
            for start in range(0, n, self.block):
                part = slice(start, min(start + self.block, n))
                plan = actions[row, part].transpose(0, 1).contiguous()  # [H, R, A]
                shared = noise.noise.shape[3] == 1
                step_noise = noise.noise[row] if shared else noise.noise[row, :, :, part]
                group = max(1, self.block // plan.shape[1])
                for first in range(0, particles, group):
                    chosen = range(first, min(first + group, particles))
                    states = torch.stack(
                        [self._carry(latent[row], plan, [m[p] for m in members], step_noise[:, p]) for p in chosen]
                    )  # [G, H, R, D]
                    in_goal = self._probability("goal", states)
                    violating = self._probability("constraint", states)
                    goal[row, part] += in_goal.sum(0).T
                    if self.constraint_reduction == "max":
                        worst = torch.maximum(constraint[row, part], violating.amax(0).T)
                        constraint[row, part] = worst
                    else:
                        constraint[row, part] += violating.sum(0).T
                    end = states[:, -1]
                    safe[row, part] += self._probability("safe_set", end).sum(0)
                    flat = end.reshape(-1, end.shape[-1])
                    for m, layers in enumerate(self._value):
                        value[row, part, m] += run_layers(flat, layers).float().reshape(len(chosen), -1).sum(0)
        if self.constraint_reduction == "mean":
            constraint /= particles
        return PlanStatistics(value / particles, goal / particles, constraint, safe / particles)

    def _probability(self, head: str, states: Tensor) -> Tensor:
        """Probabilities ``[...]`` by a head of latents ``[..., D]``."""
        logit = run_layers(states.reshape(-1, states.shape[-1]), self._heads[head])
        return logit.float().sigmoid().reshape(states.shape[:-1])

    def _carry(self, latent: Tensor, plan: Tensor, members: list[int], noise: Tensor) -> Tensor:
        """One particle of every plan ``[H, R, A]``: the latents ``[H, R, D]`` it visits, in layer precision."""
        low, high = self.env.dynamics.log_scale_bounds
        state = latent.expand(plan.shape[1], -1)
        path = []
        for action, member, step_noise in zip(plan, members, noise, strict=True):
            inputs = torch.cat([state, action], -1).to(self._dtype)
            delta, log_scale = run_layers(inputs, self._dynamics[member]).float().chunk(2, -1)
            state = torch.addcmul(state + delta, log_scale.clamp(low, high).exp(), step_noise.expand_as(delta))
            path.append(state.to(self._dtype))
        return torch.stack(path)
