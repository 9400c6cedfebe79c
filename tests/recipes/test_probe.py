"""The probe that reads the state back from the latents."""

import pytest
import torch
from tensordict import TensorDict

from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag
from probe import kernel_ridge, state_error


def test_kernel_ridge_solves_its_normal_equations():
    torch.manual_seed(0)
    x, y = torch.randn(30, 3, dtype=torch.double), torch.randn(30, 2, dtype=torch.double)
    weights, offset, width = kernel_ridge(x, y, ridge=0.1)
    kernel = torch.stack([torch.stack([(-((a - b) ** 2).sum() / (2 * width**2)).exp() for b in x]) for a in x])
    assert torch.allclose(kernel @ weights + 0.1 * weights, y - offset)
    assert torch.allclose(offset, y.mean(0))


class Reader(torch.nn.Module):
    """Stands for an encoder whose means are the brightness of two pixels, or nothing."""

    def __init__(self, blind):
        super().__init__()
        self.blind = blind

    def forward(self, td):
        corner = td["pixels"][:, :2, 0, 0].float()
        return td.set("loc", torch.randn_like(corner) if self.blind else corner / 10.0)


@pytest.mark.parametrize("blind", [False, True])
def test_the_error_is_small_where_the_latent_tells_the_state_and_large_where_it_does_not(blind):
    torch.manual_seed(0)
    pixels = torch.randint(0, 200, (40, 50, 3, 64, 64), dtype=torch.uint8)[:, :, :, :1, :1].expand(-1, -1, -1, 2, 2)
    episodes = TensorDict({"pixels": pixels, "state": pixels[..., :2, 0, 0].float()}, [40, 50])
    agent = LS3Agent(action_dim=2, latent_dim=4)
    agent.encoder = torch.nn.ModuleList([Reader(blind)])
    error = state_error(agent, {Tag.SUCCESS: episodes}, frames=1500)
    assert (error > 50.0) if blind else (error < 3.0)


def test_without_states_there_is_nothing_to_probe():
    episodes = TensorDict({"pixels": torch.zeros(2, 3, 3, 64, 64, dtype=torch.uint8)}, [2, 3])
    assert state_error(LS3Agent(action_dim=2, latent_dim=4), {Tag.SUCCESS: episodes}) is None
