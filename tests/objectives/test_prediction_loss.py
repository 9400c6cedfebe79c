"""The companion of equation (1) restated by hand: the squared distance from imagined to encoded next latents."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from ls3_torchrl.modules import EnsembleDynamics, PixelEncoder
from ls3_torchrl.objectives import LatentPredictionLoss


def images(*greys: float) -> torch.Tensor:
    return torch.tensor(greys).reshape(-1, 1, 1, 1).expand(-1, 3, 64, 64).contiguous()


def grey_reader() -> PixelEncoder:
    """An encoder whose only latent is the image's grey value."""
    encoder = PixelEncoder(latent_dim=1)
    with torch.no_grad():
        for name, parameter in encoder.named_parameters():
            parameter.zero_()
            if "convolutions" in name and name.endswith("weight"):  # each layer averages what it sees
                parameter.fill_(1 / parameter[0].numel())
            elif "head.weight" in name:
                parameter[0].fill_(1 / parameter.shape[1])
    return encoder


def movers() -> EnsembleDynamics:
    """Member 0 adds the action, member 1 twice the action."""
    dynamics = EnsembleDynamics(1, 1, num_members=2, hidden=())
    with torch.no_grad():
        dynamics.network.weights[0].zero_()[:, 1, 0] = torch.tensor([1.0, 2.0])
        dynamics.network.biases[0].zero_()
    return dynamics


def test_the_error_is_that_of_every_members_mean():
    loss = LatentPredictionLoss(grey_reader(), movers())
    batch = TensorDict(
        {"pixels": images(0.2, 0.5), "action": torch.tensor([[0.1], [-0.2]]), "next": {"pixels": images(0.4, 0.2)}}, [2]
    )
    # Imagined: 0.3 and 0.4 for the first row, 0.3 and 0.1 for the second.
    by_hand = (0.1**2 + 0.0**2 + 0.1**2 + 0.1**2) / 4
    assert loss(batch)["loss_prediction"].item() == pytest.approx(by_hand, rel=1e-4)
    assert batch.keys() == {"pixels", "action", "next"}


def test_over_several_actions_every_member_carries_its_own_mean_on():
    loss = LatentPredictionLoss(grey_reader(), movers())
    actions = torch.tensor([[[0.1], [0.1]], [[-0.2], [0.1]]])
    batch = TensorDict({"pixels": images(0.2, 0.5), "action": actions, "next": {"pixels": images(0.4, 0.2)}}, [2])
    # Imagined: 0.4 and 0.6 for the first row, 0.4 and 0.3 for the second.
    by_hand = (0.0**2 + 0.2**2 + 0.2**2 + 0.1**2) / 4
    assert loss(batch)["loss_prediction"].item() == pytest.approx(by_hand, rel=1e-4)


def test_encoder_and_dynamics_learn_through_both_images():
    encoder, dynamics = PixelEncoder(latent_dim=3), EnsembleDynamics(3, 2, num_members=2, hidden=(8,))
    loss = LatentPredictionLoss(encoder, dynamics)
    first, second = (torch.rand(4, 3, 64, 64, requires_grad=True) for _ in range(2))
    batch = TensorDict({"pixels": first, "action": torch.randn(4, 2), "next": {"pixels": second}}, [4])
    loss(batch)["loss_prediction"].backward()
    assert first.grad.abs().sum() > 0
    assert second.grad.abs().sum() > 0
    assert all(p.grad is not None for p in dynamics.parameters())


def test_minimising_it_makes_a_step_predictable(minimise):
    torch.manual_seed(0)
    start, action = torch.rand(16) * 0.5, torch.rand(16, 1) * 0.5
    batch = TensorDict(
        {"pixels": images(*start), "action": action, "next": {"pixels": images(*(start + action[:, 0]))}}, [16]
    )
    encoder = PixelEncoder(latent_dim=2)
    loss = LatentPredictionLoss(encoder, EnsembleDynamics(2, 1, num_members=2, hidden=(16,)))
    first, last = minimise(loss, batch, "loss_prediction", steps=60, lr=1e-3)
    assert last < 0.2 * first


def test_nested_keys():
    loss = LatentPredictionLoss(grey_reader(), movers())
    flat = TensorDict({"pixels": images(0.2), "action": torch.ones(1, 1), "next": {"pixels": images(0.4)}}, [1])
    loss.set_keys(pixels=("camera", "now"), action=("robot", "action"), next_pixels=("camera", "then"))
    nested = TensorDict(
        {"camera": {"now": flat["pixels"], "then": flat["next", "pixels"]}, "robot": {"action": flat["action"]}}, [1]
    )
    plain = LatentPredictionLoss(grey_reader(), movers())
    torch.testing.assert_close(loss(nested)["loss_prediction"], plain(flat)["loss_prediction"])
    assert loss.in_keys == [("camera", "now"), ("robot", "action"), ("camera", "then")]


def test_missing_keys_are_named():
    with pytest.raises(KeyError, match=r"LatentPredictionLoss needs the keys \['action'\]"):
        LatentPredictionLoss(grey_reader(), movers())(
            TensorDict({"pixels": images(0.2), "next": {"pixels": images(0.4)}}, [1])
        )


# Modules of other makes


@pytest.mark.parametrize("out_keys", [["latent"], [("q", "z")], ["loc", "scale"]])
@pytest.mark.parametrize("steps", [1, 2])
def test_any_encoder_and_any_dynamics(out_keys: list, steps: int):
    halved = nn.Linear(2, 2, bias=False)
    nn.init.constant_(halved.weight, 0.5)
    encoder = TensorDictModule(lambda x: (halved(x),) * len(out_keys), [("robot", "state")], out_keys)
    moving = nn.Linear(1, 2, bias=False)
    dynamics = TensorDictModule(
        lambda z, a: (z + moving(a), a), [("model", "z"), ("model", "a")], [("model", "next_z"), "something"]
    )
    loss = LatentPredictionLoss(encoder, dynamics)
    loss.set_keys(pixels="state", next_pixels=("next", "state"))
    state, after, action = torch.randn(5, 2), torch.randn(5, 2), torch.randn(5, steps, 1)
    batch = TensorDict({"state": state, "action": action if steps > 1 else action[:, 0], "next": {"state": after}}, [5])
    out = loss(batch)["loss_prediction"]
    by_hand = halved(state) + sum(moving(action[:, k]) for k in range(steps)) - halved(after)
    torch.testing.assert_close(out, by_hand.square().mean())
    out.backward()
    assert halved.weight.grad.abs().sum() > 0
    assert moving.weight.grad.abs().sum() > 0


def test_a_subclass_of_the_pixel_encoder_is_not_bypassed():
    class Far(PixelEncoder):
        def forward(self, tensordict: TensorDict) -> TensorDict:
            tensordict = super().forward(tensordict)
            return tensordict.set("loc", torch.tensor([[3.0], [7.0]]))

    loss = LatentPredictionLoss(Far(latent_dim=1), movers())
    batch = TensorDict({"pixels": images(0.2), "action": torch.tensor([[1.0]]), "next": {"pixels": images(0.4)}}, [1])
    # Imagined: 4 and 5.
    assert loss(batch)["loss_prediction"].item() == pytest.approx((3.0**2 + 2.0**2) / 2)
