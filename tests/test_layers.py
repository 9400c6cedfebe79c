import pytest
import torch
from torch import nn

from ls3_torchrl._memory import keep_freed_memory
from ls3_torchrl.layers import fastest_precision, members_of, relu_, run_layers, run_stacked


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_layers_run_as_a_relu_network(dtype):
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(5, 16), nn.ReLU(), nn.Linear(16, 16), nn.ReLU(), nn.Linear(16, 3))
    layers = [(m.weight.detach().to(dtype), m.bias.detach().to(dtype)) for m in net if isinstance(m, nn.Linear)]
    x = torch.randn(40, 5)
    tolerance = 1e-6 if dtype == torch.float32 else 0.02
    torch.testing.assert_close(run_layers(x.to(dtype), layers).float(), net(x).detach(), atol=tolerance, rtol=0)


def test_measuring_the_precision_draws_nothing_from_the_random_stream():
    fastest_precision.cache_clear()
    before = torch.random.get_rng_state()
    fastest_precision("cpu")
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_negative_numbers_become_zero_in_place(dtype):
    x = torch.tensor([-torch.inf, -3.5, -1e-30, -0.0, 0.0, 1e-30, 2.0, torch.inf], dtype=dtype)
    relued = x.clone()
    assert relu_(relued) is relued
    assert torch.equal(relued, x.clamp(min=0.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_stacked_networks_write_what_each_does_alone(dtype):
    torch.manual_seed(0)
    sizes = [(5, 16), (16, 16), (16, 3)]
    stacked = [(torch.randn(4, a, b).to(dtype) / a**0.5, torch.randn(4, 1, b).to(dtype)) for a, b in sizes]
    x = torch.randn(4, 7, 5).to(dtype)
    alone = torch.stack([run_layers(rows, layers) for rows, layers in zip(x, members_of(stacked), strict=True)])
    tolerance = 1e-6 if dtype == torch.float32 else 0.02
    torch.testing.assert_close(run_stacked(x, stacked), alone, atol=tolerance, rtol=tolerance)
    same = run_stacked(x[:1].expand(4, -1, -1), stacked)  # rows that all networks see
    torch.testing.assert_close(same[0], alone[0], atol=tolerance, rtol=tolerance)


def test_freed_memory_is_kept_without_touching_any():
    resource = pytest.importorskip("resource")
    keep_freed_memory.cache_clear()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    keep_freed_memory()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 4 << 10  # KiB; it asked for 31 MiB
