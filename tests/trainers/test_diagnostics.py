"""The probe that reads the state back from the latents."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from ls3_torchrl import LS3Agent
from ls3_torchrl.trainers import StateProbe


def encoder(blind):
    """An encoder whose latent is the brightness of two pixels, or nothing of the image."""

    def read(pixels):
        corner = pixels[:, :2, 0, 0].float()
        return torch.randn_like(corner) if blind else corner / 10.0

    return TensorDictModule(read, ["pixels"], ["latent"])


class Mover(torch.nn.Module):
    """Stands for dynamics that move the latent by ``gain`` times the action."""

    def __init__(self, gain):
        super().__init__()
        self.gain = gain

    def distribution(self, latent, action):
        mean = (latent + self.gain * action).unsqueeze(-2).expand(-1, 3, -1)
        return mean, torch.ones_like(mean)


def walks(steps):
    """Episodes whose state, shown by one pixel of each channel, moves by ten times the action."""
    action = torch.randint(-1, 2, (20, steps, 2)).float()
    start = torch.randint(60, 140, (20, 1, 2)).float()
    state = start + 10 * torch.cat([torch.zeros(20, 1, 2), action.cumsum(1)], 1)
    pixels = torch.zeros(20, steps + 1, 3, 1, 1, dtype=torch.uint8)
    pixels[..., :2, 0, 0] = state.clamp(0, 255).to(torch.uint8)
    reached = {"state": state[:, 1:], "pixels": pixels[:, 1:]}
    return TensorDict(
        {"pixels": pixels[:, :-1], "state": state[:, :-1], "action": action, "next": reached}, [20, steps]
    )


def agent_with(*, blind=False, gain=1.0):
    return LS3Agent(action_dim=2, latent_dim=2, encoder=encoder(blind), dynamics=Mover(gain))


@pytest.mark.parametrize("blind", [False, True])
def test_the_error_is_small_where_the_latent_tells_the_state_and_large_where_it_does_not(blind):
    error = StateProbe(agent_with(blind=blind), [walks(6)], progress=False).error
    assert (error > 10.0) if blind else (error < 2.0)


@pytest.mark.parametrize("gain", [1.0, 0.0])
def test_imagined_ends_are_compared_with_where_the_actions_led(gain):
    episodes = walks(6)
    probe = StateProbe(agent_with(gain=gain), [episodes], progress=False)
    error = probe.imagination_error(episodes, horizon=3, stride=1)
    starts, ends = episodes["state"][:, :4], episodes["next", "state"][:, 2:]
    moved = (ends - starts).norm(dim=-1).mean().item()
    assert error < 3.0 if gain else error == pytest.approx(moved, abs=2.0)


def test_dynamics_without_members_are_compared_alike():
    class Lone(Mover):
        def distribution(self, latent, action):
            return tuple(value[:, 0] for value in super().distribution(latent, action))

    episodes = walks(6)
    errors = []
    for dynamics in (Mover(1.0), Lone(1.0)):
        agent = LS3Agent(action_dim=2, latent_dim=2, encoder=encoder(False), dynamics=dynamics)
        errors.append(StateProbe(agent, [episodes], progress=False).imagination_error(episodes, horizon=3))
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)


def test_without_states_there_is_nothing_to_probe():
    episodes = TensorDict({"pixels": torch.zeros(2, 3, 3, 64, 64, dtype=torch.uint8)}, [2, 3])
    with pytest.raises(KeyError, match="state"):
        StateProbe(LS3Agent(action_dim=2, latent_dim=4), [episodes], progress=False)


def test_episodes_shorter_than_what_is_imagined_are_refused():
    episodes = walks(2)
    probe = StateProbe(agent_with(), [episodes], steps=2, progress=False)
    with pytest.raises(ValueError, match="2 steps are too short to imagine 3"):
        probe.imagination_error(episodes, horizon=3)


def test_a_probe_leaves_the_random_stream_of_training_alone():
    agent, episodes = agent_with(), walks(3)
    torch.manual_seed(4)
    expected = torch.rand(3)
    torch.manual_seed(4)
    StateProbe(agent, [episodes], steps=5, progress=False)
    assert torch.equal(torch.rand(3), expected)
