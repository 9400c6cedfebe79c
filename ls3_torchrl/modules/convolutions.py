"""Convolutions that take less time on CPUs than PyTorch's, with the same results."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

#: Output channels that fill too little of a vector for a transposed convolution to be fast.
_FEW_CHANNELS = 16
#: Channels with which the gradient of a weight takes less time as a matrix product.
_MANY_CHANNELS = 128


def _in_memory_order(images: Tensor) -> Tensor:
    """Images ``[B, C, H, W]`` as rows, pixel by pixel: no copy where they are kept channels last."""
    return images.permute(0, 2, 3, 1).flatten(1)


def _computed_in(input: Tensor) -> torch.dtype:
    """The dtype of a layer: autocast's where that is on."""
    return torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else input.dtype


class _Product(torch.autograd.Function):
    """Rows ``[B, n]`` times a matrix ``[n, m]``, whose gradient is computed in the matrix's own precision.

    A layer of few rows and many weights spends its time on the weights: a gradient in bf16 would have to be converted.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, dtype: torch.dtype) -> Tensor:
        computed, ctx.dtypes = (rows.to(dtype), weight.to(dtype)), (rows.dtype, weight.dtype)
        ctx.save_for_backward(*computed)
        return computed[0] @ computed[1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        rows, weight = ctx.saved_tensors
        of_rows = of_weight = None
        if ctx.needs_input_grad[0]:
            of_rows = (gradient @ weight.T).to(ctx.dtypes[0])
        if ctx.needs_input_grad[1]:
            left, right = (x.to(ctx.dtypes[1]) for x in (rows, gradient))
            # In the weight's order of memory.
            of_weight = left.T @ right if weight.is_contiguous() else (right.T @ left).T
        return of_rows, of_weight, None


def _weight_gradient(small: Tensor, large: Tensor, kernel: int, stride: int) -> Tensor:
    """Gradient ``[C, c, k, k]`` of a convolution of ``large`` ``[B, c, H, W]`` to ``small`` ``[B, C, H', W']``.

    As one matrix product of all patches: with many channels PyTorch's takes two to three times as long.
    """
    patches = large.permute(0, 2, 3, 1).unfold(1, kernel, stride).unfold(2, kernel, stride).permute(0, 1, 2, 4, 5, 3)
    columns = patches.reshape(-1, patches[0, 0, 0].numel())
    product = small.permute(0, 2, 3, 1).reshape(-1, small.shape[1]).T @ columns
    return product.unflatten(1, (kernel, kernel, large.shape[1])).permute(0, 3, 1, 2)


class _Convolution(torch.autograd.Function):
    """``conv2d`` for CPUs with many output channels: the same result, with a weight's gradient that takes less time."""

    @staticmethod
    def forward(input: Tensor, weight: Tensor, bias: Tensor, stride: int) -> Tensor:
        return nn.functional.conv2d(input, weight, bias, stride)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor, int], output: Tensor) -> None:
        input, weight, _, ctx.stride = inputs
        ctx.save_for_backward(input, weight)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None, None]:
        input, weight = ctx.saved_tensors
        of_input = of_weight = None
        if ctx.needs_input_grad[0]:
            stride, wanted = [ctx.stride] * 2, [True, False, False]
            of_input = torch.ops.aten.convolution_backward(
                gradient, input, weight, None, stride, [0, 0], [1, 1], False, [0, 0], 1, wanted
            )[0]
        if ctx.needs_input_grad[1]:
            of_weight = _weight_gradient(gradient, input, weight.shape[-1], ctx.stride)
        return of_input, of_weight, gradient.sum((0, 2, 3)) if ctx.needs_input_grad[2] else None, None


class FastConv2d(nn.Conv2d):
    """A convolution, the same result in less time; one matrix product where the kernel covers the whole input."""

    def forward(self, input: Tensor) -> Tensor:
        """Images ``[B, out, H', W']`` of images ``[B, in, H, W]``; on other devices as PyTorch computes them."""
        assert self.bias is not None
        covered = tuple(input.shape[-2:]) == self.kernel_size
        if input.device.type != "cpu" or not (covered or self.out_channels >= _MANY_CHANNELS):
            return super().forward(input)
        dtype = _computed_in(input)
        if covered:
            image = _Product.apply(_in_memory_order(input), _in_memory_order(self.weight).T, dtype)
            return image.add_(self.bias.to(image.dtype))[..., None, None]
        return _Convolution.apply(*(x.to(dtype) for x in (input, self.weight, self.bias)), self.stride[0])


class _TransposedConvolution(torch.autograd.Function):
    """``conv_transpose2d`` for CPUs: the same result, forwards and backwards each the way that is faster there.

    The bias's gradient is a plain sum: the library's own can take longer than those of input and weights together. With
    few output channels the way forwards is an ordinary convolution that writes the stride² pixels under each input
    pixel as channels (Shi et al. 2016, arXiv 1609.07009).
    """

    @staticmethod
    def forward(input: Tensor, weight: Tensor, bias: Tensor, stride: int) -> Tensor:
        channels, kernel = weight.shape[1], weight.shape[-1]
        if channels >= _FEW_CHANNELS or kernel % stride:
            return nn.functional.conv_transpose2d(input, weight, bias, stride)
        # out[s q + r] = Σ_j in[q - j] w[s j + r]: for each r a convolution with every s-th tap, last to first.
        taps = kernel // stride
        phases = weight.unflatten(-1, (taps, stride)).unflatten(-3, (taps, stride)).flip(2, 4)
        phases = phases.permute(3, 5, 1, 0, 2, 4).flatten(0, 2).contiguous(memory_format=torch.channels_last)
        made = nn.functional.conv2d(input, phases, bias.repeat(stride**2), padding=taps - 1).permute(0, 2, 3, 1)
        size = [len(input), channels, *(stride * side for side in made.shape[1:3])]
        out = torch.empty(size, dtype=made.dtype, device=made.device, memory_format=torch.channels_last)
        shuffled = out.permute(0, 2, 3, 1).unflatten(2, (-1, stride)).unflatten(1, (-1, stride))
        shuffled.copy_(made.unflatten(-1, (stride, stride, channels)).transpose(2, 3))
        return out

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor, int], output: Tensor) -> None:
        input, weight, _, ctx.stride = inputs
        ctx.save_for_backward(input, weight)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None, None]:
        input, weight = ctx.saved_tensors
        as_product = input.shape[1] >= _MANY_CHANNELS
        wanted = [ctx.needs_input_grad[0], ctx.needs_input_grad[1] and not as_product, False]
        stride = [ctx.stride] * 2
        of_input, of_weight, _ = torch.ops.aten.convolution_backward(
            gradient, input, weight, None, stride, [0, 0], [1, 1], True, [0, 0], 1, wanted
        )
        if as_product and ctx.needs_input_grad[1]:
            of_weight = _weight_gradient(input, gradient, weight.shape[-1], ctx.stride)
        return of_input, of_weight, gradient.sum((0, 2, 3)) if ctx.needs_input_grad[2] else None, None


class FastConvTranspose2d(nn.ConvTranspose2d):
    """A transposed convolution, the same result in less time; one matrix product where the input is a single pixel."""

    def forward(self, input: Tensor, output_size: list[int] | None = None) -> Tensor:
        """Images ``[B, out, H', W']`` of images ``[B, in, H, W]``; on other devices as PyTorch computes them."""
        if output_size is not None or input.device.type != "cpu":
            return super().forward(input, output_size)
        assert self.bias is not None
        dtype = _computed_in(input)
        if tuple(input.shape[-2:]) == (1, 1):
            channels, *kernel = self.weight.shape[1:]
            image = _Product.apply(input.flatten(1), _in_memory_order(self.weight), dtype)
            image = image.unflatten(-1, (*kernel, channels))
            return image.add_(self.bias.to(image.dtype)).permute(0, 3, 1, 2)
        operands = (x.to(dtype) for x in (input, self.weight, self.bias))
        return _TransposedConvolution.apply(*operands, self.stride[0])
