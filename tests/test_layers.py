import pytest
import torch
from torch import nn

from ls3_torchrl.layers import fastest_precision, run_layers


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
