"""Copies of ReLU networks' layers, run in the precision that is fastest here."""

from __future__ import annotations

import time
from functools import lru_cache
from typing import Literal, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import linear
from torchrl.modules import MLP

from ls3_torchrl.modules.ensemble import EnsembleMLP
from ls3_torchrl.modules.relu import relu_

#: A network's layers: weight ``[out, in]`` and bias ``[out]``, ReLU between them.
Layers = list[tuple[Tensor, Tensor]]


def is_relu_mlp(network: nn.Module) -> bool:
    """Whether a network is linear layers with ReLU between them, and nothing else.

    Types are compared exactly: a subclass of a linear layer, such as a noisy or a parametrised one, computes something
    else than its weight and bias say.
    """
    if type(network) not in (nn.Sequential, MLP):
        return False
    layers = list(cast(nn.Sequential, network))
    return len(layers) % 2 == 1 and all(
        type(layer) is (nn.Linear if i % 2 == 0 else nn.ReLU) and getattr(layer, "bias", 0) is not None
        for i, layer in enumerate(layers)
    )


def layers_of(network: nn.Module, dtype: torch.dtype) -> Layers:
    """Copies of a plain network's layers."""
    assert isinstance(network, nn.Sequential)
    return [
        (layer.weight.detach().to(dtype).clone(), layer.bias.detach().to(dtype).clone())
        for layer in network
        if isinstance(layer, nn.Linear)
    ]


def stacked_of(network: EnsembleMLP, dtype: torch.dtype) -> Layers:
    """Copies of an ensemble's layers: weights ``[M, in, out]`` and biases ``[M, 1, out]``."""
    return [
        (weight.detach().to(dtype).clone(), bias.detach().to(dtype).clone())
        for weight, bias in zip(network.weights, network.biases, strict=True)
    ]


def members_of(stacked: Layers) -> list[Layers]:
    """Copies of stacked layers, one member after another, each as those of a network of its own."""
    return [
        [(weight[m].T.contiguous(), bias[m, 0].clone()) for weight, bias in stacked] for m in range(len(stacked[0][0]))
    ]


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
            x = relu_(x)
    return x


def run_stacked(x: Tensor, layers: Layers) -> Tensor:
    """M ReLU networks on rows ``[M, R, in]``, each on its own: weights ``[M, in, out]`` and biases ``[M, 1, out]``.

    A product here costs some 20 microseconds before its first number: one for all members, where each has few rows, is
    several times faster than one for each.
    """
    last = len(layers) - 1
    for i, (weight, bias) in enumerate(layers):
        x = torch.baddbmm(bias, x, weight)
        if i < last:
            x = relu_(x)
    return x


@lru_cache(maxsize=4)
def fastest_precision(device_type: str) -> Literal["fp32", "bf16"]:
    """Choose by measuring a layer of the heads' size; CUDA takes bf16, other devices what is clearly faster."""
    if device_type != "cpu":
        return "bf16" if device_type == "cuda" and torch.cuda.is_bf16_supported() else "fp32"
    # From a stream of its own: what is measured once a process must not move the numbers that training draws.
    own = torch.Generator().manual_seed(0)
    x, weight, bias = (torch.randn(size, generator=own) for size in ((2048, 256), (256, 256), (256,)))
    inputs = {
        dtype: (x.to(dtype), [(weight.to(dtype), bias.to(dtype))] * 3) for dtype in (torch.float32, torch.bfloat16)
    }
    seconds: dict[torch.dtype, list[float]] = {dtype: [] for dtype in inputs}
    for _ in range(8):
        for dtype, (rows, layers) in inputs.items():
            start = time.process_time()  # of CPU time, in turns: what else runs must not decide
            run_layers(rows, layers)
            seconds[dtype].append(time.process_time() - start)
    return "bf16" if min(seconds[torch.bfloat16]) < 0.67 * min(seconds[torch.float32]) else "fp32"
