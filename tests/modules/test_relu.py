"""ReLU in bf16: the same numbers and derivatives as PyTorch's, special ones included."""

import pytest
import torch
from torch import nn
from torch.autograd import forward_ad

from ls3_torchrl.modules.relu import FastReLU, relu_

SPECIAL = [0.0, -0.0, 1e-40, -1e-40, float("inf"), -float("inf"), 3.0, -3.0]


def numbers(dtype: torch.dtype) -> torch.Tensor:
    torch.manual_seed(0)
    return torch.cat([torch.tensor(SPECIAL), torch.randn(8 * 3 * 4 * 4 - len(SPECIAL))]).to(dtype).view(8, 3, 4, 4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
def test_it_and_its_gradient_are_relus(dtype, memory_format):
    found = []
    for relu in (FastReLU(), nn.ReLU(inplace=True)):
        x = numbers(dtype).contiguous(memory_format=memory_format).requires_grad_()
        before = x * 1
        out = relu(before)
        assert out.data_ptr() == before.data_ptr()
        (gradient,) = torch.autograd.grad(out, x, torch.linspace(-1, 1, x.numel()).to(dtype).view_as(x))
        found.append((out.detach(), gradient))
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(*found, strict=True))
    assert torch.equal(relu_(numbers(dtype)), found[0][0])  # without a gradient as well


def test_a_gradient_of_another_dtype_is_kept():
    x = numbers(torch.bfloat16).requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        relu_(x * 1).float().square().sum().backward()
    assert torch.equal(x.grad, 2 * numbers(torch.bfloat16).relu())


@pytest.mark.parametrize("gradient", [False, True])
def test_every_number_of_bf16_is_what_relu_makes_of_it(gradient):
    every = torch.arange(-(2**15), 2**15).to(torch.int16).view(torch.bfloat16).requires_grad_(gradient)
    ours, theirs = relu_(every * 1).detach(), (every * 1).relu_().detach()
    assert torch.equal(ours.isnan(), theirs.isnan())
    assert ours.isnan().sum() == 2 * 127
    assert torch.equal(ours.nan_to_num(1.0), theirs.nan_to_num(1.0))


def test_it_compiles_in_one_graph():
    made = torch.compile(lambda x: relu_(x * 2).sum(), fullgraph=True, backend="eager")
    x = numbers(torch.bfloat16).nan_to_num(0, 1, -1)
    assert made(x) == relu_(x * 2).sum()


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:FutureWarning")  # PyTorch's own, in jvp
def test_derivatives_of_every_kind_are_relus():
    x, tangent = numbers(torch.bfloat16).nan_to_num(0, 1, -1), torch.ones(8, 3, 4, 4).bfloat16()

    def ours(x):
        return relu_(x * 2).square()

    def theirs(x):
        return (x * 2).relu_().square()

    kinds = {
        "jvp": lambda f: torch.func.jvp(f, (x,), (tangent,)),
        "vjp": lambda f: torch.func.vjp(f, x)[1](tangent),
        "vmapped gradient": lambda f: torch.func.vmap(torch.func.grad(lambda row: f(row).sum()))(x),
        "hessian": lambda f: torch.func.hessian(lambda row: f(row).sum())(x[0, 0, 0]),
        "many gradients": lambda f: torch.autograd.functional.jacobian(f, x[0, 0, 0], vectorize=True),
        "gradient of the gradient": lambda f: second_derivative(f, x),
        "forward": lambda f: forward_derivative(f, x, tangent),
    }
    for name, kind in kinds.items():
        for mine, its in zip(flat(kind(ours)), flat(kind(theirs)), strict=True):
            assert torch.equal(mine, its), name


def second_derivative(f, x):
    x = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(f(x).sum(), x, create_graph=True)
    return torch.autograd.grad(gradient.square().sum(), x)[0]


def forward_derivative(f, x, tangent):
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(f(forward_ad.make_dual(x, tangent))).tangent.clone()


def flat(found):
    return [part for one in found for part in flat(one)] if isinstance(found, tuple) else [found]
