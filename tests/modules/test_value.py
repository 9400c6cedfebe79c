"""ValueEnsemble: sizes, keys and members."""

import pytest
import torch
from tensordict import TensorDict

from ls3_torchrl.modules import ValueEnsemble


def test_default_network_is_five_members_of_three_layers_of_256():
    value = ValueEnsemble(latent_dim=32)
    assert [tuple(weight.shape) for weight in value.network.weights] == [
        (5, 32, 256),
        (5, 256, 256),
        (5, 256, 256),
        (5, 256, 1),
    ]


def test_value_is_linear_in_the_latent_when_there_are_no_hidden_layers():
    value = ValueEnsemble(2, num_members=2, hidden=())
    with torch.no_grad():
        value.network.weights[0].copy_(torch.tensor([[[1.0], [2.0]], [[-1.0], [0.5]]]))
        value.network.biases[0].copy_(torch.tensor([[[0.0]], [[10.0]]]))
    out = value(TensorDict({"latent": torch.tensor([[3.0, 4.0], [0.0, -2.0]])}, [2]))["state_value"]
    assert out.shape == (2, 2, 1)
    assert out[..., 0].tolist() == [[3.0 + 8.0, -3.0 + 2.0 + 10.0], [-4.0, -1.0 + 10.0]]


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_every_member_judges_every_row(batch: tuple[int, ...]):
    value = ValueEnsemble(8, hidden=(16,))
    latent = torch.randn(*batch, 8)
    out = value(TensorDict({"latent": latent}, batch))["state_value"]
    assert out.shape == (*batch, 5, 1)
    spread = out.squeeze(-1).std(-1)
    assert (spread > 0).all()  # five different networks, not one five times


def test_per_member_latents_go_to_their_own_member():
    value = ValueEnsemble(8, num_members=3, hidden=(16,))
    latent = torch.randn(4, 3, 8)
    out = value(TensorDict({"latent": latent}, [4]), per_member=True)["state_value"]
    for m in range(3):
        shared = value(TensorDict({"latent": latent[:, m]}, [4]))["state_value"]
        torch.testing.assert_close(out[:, m], shared[:, m])


def test_nested_keys():
    value = ValueEnsemble(8, hidden=(16,), latent_key=("model", "z"), value_key=("critic", "v"))
    td = value(TensorDict({"model": {"z": torch.randn(4, 8)}}, [4]))
    assert td["critic", "v"].shape == (4, 5, 1)
    assert value.in_keys == [("model", "z")]
    assert value.out_keys == [("critic", "v")]


def test_missing_latent_is_named():
    with pytest.raises(KeyError, match=r"ValueEnsemble needs the keys \['latent'\].*It has: z"):
        ValueEnsemble(8, hidden=(16,))(TensorDict({"z": torch.zeros(4, 8)}, [4]))


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_it_computes_in_the_dtype_it_was_moved_to(dtype: torch.dtype):
    value, latent = ValueEnsemble(8, hidden=(16,)), torch.randn(4, 8)
    before = value(TensorDict({"latent": latent}, [4]))["state_value"]
    after = value.to(dtype)(TensorDict({"latent": latent.to(dtype)}, [4]))["state_value"]
    assert after.dtype == dtype
    tolerance = 1e-6 if dtype == torch.float64 else 0.02
    torch.testing.assert_close(after, before.to(dtype), atol=tolerance, rtol=tolerance)
