"""EnsembleMLP against the plain way of writing it: a loop over nn.Linear members."""

import math

import pytest
import torch
from torch import Tensor, nn

from ls3_torchrl.modules import EnsembleMLP


def as_linear_members(net: EnsembleMLP) -> list[nn.Sequential]:
    """Copies of the members as sequences of nn.Linear and nn.ReLU."""
    members = []
    for m in range(net.num_members):
        layers: list[nn.Module] = []
        for weight, bias in zip(net.weights, net.biases, strict=True):
            layer = nn.Linear(weight.shape[1], weight.shape[2])
            with torch.no_grad():
                layer.weight.copy_(weight[m].T)
                layer.bias.copy_(bias[m, 0])
            layers += [layer, nn.ReLU()]
        members.append(nn.Sequential(*layers[:-1]))
    return members


@pytest.mark.parametrize("batch", [(), (6,), (2, 3)])
@pytest.mark.parametrize("hidden", [(), (7,), (8, 5)])
def test_shared_input_equals_a_loop_over_linear_members(batch: tuple[int, ...], hidden: tuple[int, ...]):
    net = EnsembleMLP(4, 2, num_members=3, hidden=hidden)
    inputs = torch.randn(*batch, 4)
    expected = torch.stack([member(inputs) for member in as_linear_members(net)], dim=-2)
    assert expected.shape == (*batch, 3, 2)
    torch.testing.assert_close(net(inputs), expected)


@pytest.mark.parametrize("batch", [(), (6,), (2, 5)])
def test_per_member_input_equals_a_loop_over_linear_members(batch: tuple[int, ...]):
    net = EnsembleMLP(4, 2, num_members=3, hidden=(8, 5))
    inputs = torch.randn(*batch, 3, 4)
    members = as_linear_members(net)
    expected = torch.stack([members[m](inputs[..., m, :]) for m in range(3)], dim=-2)
    torch.testing.assert_close(net(inputs, per_member=True), expected)


def test_gradients_equal_those_of_the_loop():
    net = EnsembleMLP(4, 2, num_members=3, hidden=(8,))
    members = as_linear_members(net)
    inputs = torch.randn(6, 4)
    net(inputs).square().sum().backward()
    for m, member in enumerate(members):
        member(inputs).square().sum().backward()
        torch.testing.assert_close(net.weights[0].grad[m], member[0].weight.grad.T)
        torch.testing.assert_close(net.biases[1].grad[m, 0], member[2].bias.grad)


def test_one_members_output_has_no_gradient_in_another():
    net = EnsembleMLP(4, 2, num_members=3, hidden=(8,))
    net(torch.randn(6, 4))[:, 0].square().sum().backward()
    for parameter in net.parameters():
        assert parameter.grad[0].abs().sum() > 0
        assert parameter.grad[1:].abs().sum() == 0


def test_members_start_different_and_within_the_range_of_a_linear_layer():
    net = EnsembleMLP(16, 2, num_members=4, hidden=(64,))
    bounds = [1 / math.sqrt(16), 1 / math.sqrt(64)]
    for bound, weight, bias in zip(bounds, net.weights, net.biases, strict=True):
        assert weight.abs().max() <= bound
        assert bias.abs().max() <= bound
        # A uniform variable on [-b, b] has standard deviation b / sqrt(3).
        assert weight.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.1)
        assert not torch.equal(weight[0], weight[1])
    outputs = net(torch.randn(5, 16))
    assert all(not torch.equal(outputs[:, 0], outputs[:, m]) for m in (1, 2, 3))


def test_default_layers_are_three_of_256():
    net = EnsembleMLP(4, 2, num_members=2)
    assert [tuple(weight.shape) for weight in net.weights] == [
        (2, 4, 256),
        (2, 256, 256),
        (2, 256, 256),
        (2, 256, 2),
    ]
    assert [tuple(bias.shape) for bias in net.biases] == [(2, 1, 256)] * 3 + [(2, 1, 2)]


def test_state_dict_moves_the_whole_ensemble():
    source, copy = (EnsembleMLP(4, 2, num_members=3, hidden=(8,)) for _ in range(2))
    inputs: Tensor = torch.randn(5, 4)
    assert not torch.equal(source(inputs), copy(inputs))
    copy.load_state_dict(source.state_dict())
    assert torch.equal(source(inputs), copy(inputs))


def test_an_ensemble_needs_a_member():
    with pytest.raises(ValueError, match="num_members must be at least 1, got 0"):
        EnsembleMLP(4, 2, num_members=0)


@pytest.mark.parametrize("shape", [(4,), (6, 4), (6, 2, 4)])
def test_per_member_input_needs_one_column_per_member(shape: tuple[int, ...]):
    net = EnsembleMLP(4, 2, num_members=3, hidden=(8,))
    with pytest.raises(ValueError, match="M = 3"):
        net(torch.zeros(shape), per_member=True)


def test_under_bf16_autocast_only_the_hidden_layers_are_rounded():
    torch.manual_seed(0)
    net, inputs = EnsembleMLP(4, 2, num_members=3, hidden=(64, 64)), torch.randn(32, 4)
    exact = net(inputs)
    with torch.autocast("cpu", torch.bfloat16):
        rough = net(inputs)
    # By hand: bf16 products up to the last hidden layer, fp32 from there on.
    hidden = inputs.bfloat16().expand(3, -1, -1)
    for weight, bias in zip(net.weights[:-1], net.biases[:-1], strict=True):
        hidden = torch.baddbmm(bias.bfloat16(), hidden, weight.bfloat16()).relu()
    by_hand = torch.einsum("mbi,mio->bmo", hidden.float(), net.weights[-1]) + net.biases[-1].transpose(0, 1)
    assert rough.dtype == torch.float32
    torch.testing.assert_close(rough, by_hand)
    torch.testing.assert_close(rough, exact, rtol=0.02, atol=0.02)
    assert not torch.equal(rough, exact)


def test_no_rows_at_all_give_none():
    network = EnsembleMLP(4, 2, num_members=3, hidden=(8,))
    assert network(torch.zeros(0, 4)).shape == (0, 3, 2)
    assert network(torch.zeros(2, 0, 3, 4), per_member=True).shape == (2, 0, 3, 2)
