"""ReLU that takes less time on CPUs in bf16."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

#: Minus infinity in bf16, read as an integer: above it are NaN and what is not below zero, up to it all the rest.
_MINUS_INFINITY = -128


class _Relu(torch.autograd.Function):
    """ReLU by integers: bf16 numbers below zero are integers below zero, and compared in a fraction of the time."""

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        torch.threshold_(x.view(torch.int16), _MINUS_INFINITY, 0)
        return x

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.mark_dirty(*inputs)
        ctx.save_for_backward(output)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (output,) = ctx.saved_tensors
        # A gradient of the gradient, or many of them at once, is PyTorch's own matter.
        many = torch._C._functorch.is_legacy_batchedtensor(gradient)
        if many or torch.is_grad_enabled() or gradient.dtype != output.dtype or _is_transformed():
            return torch.ops.aten.threshold_backward(gradient, output, 0)
        kept = torch.ops.aten.threshold_backward(gradient.view(torch.int16), output.view(torch.int16), 0)
        return kept.view(torch.bfloat16)


def _is_transformed() -> bool:
    """Whether more happens to a tensor than is computed: compilation, ``torch.func``, forward derivatives."""
    followed = torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0
    return followed or torch.compiler.is_compiling()


def relu_(x: Tensor) -> Tensor:
    """ReLU in place, NaN included; in bf16 on a CPU -0 becomes 0."""
    if x.dtype != torch.bfloat16 or x.device.type != "cpu" or _is_transformed():
        return x.relu_()
    if torch.is_grad_enabled() and x.requires_grad:
        return _Relu.apply(x)
    torch.threshold_(x.view(torch.int16), _MINUS_INFINITY, 0)
    return x


class FastReLU(nn.ReLU):
    """ReLU in place that takes less time; see :func:`relu_`.

    Example:
        >>> FastReLU()(torch.tensor([-1.0, 2.0], dtype=torch.bfloat16))
        tensor([0., 2.], dtype=torch.bfloat16)
    """

    def __init__(self) -> None:
        super().__init__(inplace=True)

    def forward(self, input: Tensor) -> Tensor:
        """The input itself, its negative numbers 0."""
        return relu_(input)
