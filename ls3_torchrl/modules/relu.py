"""ReLU that takes less time on CPUs in bf16, with the same results."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable


class _Relu(torch.autograd.Function):
    """bf16 numbers below zero are integers below zero, and integers are compared several times faster."""

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        x.view(torch.int16).relu_()
        return x

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.mark_dirty(*inputs)
        ctx.save_for_backward(output)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (output,) = ctx.saved_tensors
        if gradient.dtype != output.dtype:
            return torch.ops.aten.threshold_backward(gradient, output, 0)
        kept = torch.ops.aten.threshold_backward(gradient.view(torch.int16), output.view(torch.int16), 0)
        return kept.view(torch.bfloat16)


def relu_(x: Tensor) -> Tensor:
    """ReLU in place. NaN in bf16 on a CPU may become 0, as it does in PyTorch's fused layers."""
    if x.dtype != torch.bfloat16 or x.device.type != "cpu" or torch.compiler.is_compiling():
        return x.relu_()
    if torch.is_grad_enabled() and x.requires_grad:
        return _Relu.apply(x)
    x.view(torch.int16).relu_()
    return x


class FastReLU(nn.ReLU):
    """ReLU in place, the same result in less time.

    Example:
        >>> FastReLU()(torch.tensor([-1.0, 2.0], dtype=torch.bfloat16))
        tensor([0., 2.], dtype=torch.bfloat16)
    """

    def __init__(self) -> None:
        super().__init__(inplace=True)

    def forward(self, input: Tensor) -> Tensor:
        """The input itself, its negative numbers 0."""
        return relu_(input)
