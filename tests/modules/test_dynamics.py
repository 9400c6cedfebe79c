"""EnsembleDynamics: the Gaussian of every member, and how particles pick members."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from ls3_torchrl.modules import EnsembleDynamics


def shifting_dynamics(num_members: int) -> EnsembleDynamics:
    """Member m adds m to the latent, nearly without noise: the latent tells which member moved it."""
    dynamics = EnsembleDynamics(1, 1, num_members=num_members, hidden=())
    with torch.no_grad():
        dynamics.network.weights[0].zero_()
        dynamics.network.biases[0][:, 0, 0] = torch.arange(float(num_members))
        dynamics.network.biases[0][:, 0, 1] = -100.0
    return dynamics


def members_used(td: TensorDict) -> torch.Tensor:
    return (td["next", "latent"] - td["latent"]).round().long().flatten()


def rest(rows: int) -> TensorDict:
    return TensorDict({"latent": torch.zeros(rows, 1), "action": torch.zeros(rows, 1)}, [rows])


def test_default_network_is_five_members_of_two_layers_of_128():
    dynamics = EnsembleDynamics(latent_dim=32, action_dim=2)
    assert [tuple(weight.shape) for weight in dynamics.network.weights] == [
        (5, 34, 128),
        (5, 128, 128),
        (5, 128, 64),
    ]


def test_next_latent_equals_a_computation_by_hand():
    dynamics = EnsembleDynamics(2, 1, num_members=2, hidden=())
    # Inputs (z0, z1, a); outputs (delta0, delta1, log_scale0, log_scale1) of each member.
    weight = torch.zeros(2, 3, 4)
    weight[0, 2, 0] = 2.0  # member 0: delta0 = 2 a
    weight[1, 0, 1] = -1.0  # member 1: delta1 = -z0
    weight[1, 2, 2] = 1.0  # member 1: log_scale0 = a + its bias
    bias = torch.tensor([[[0.0, 0.1, math.log(0.5), 0.0]], [[0.3, 0.0, -1.0, math.log(2.0)]]])
    with torch.no_grad():
        dynamics.network.weights[0].copy_(weight)
        dynamics.network.biases[0].copy_(bias)
    td = TensorDict(
        {
            "latent": torch.tensor([[1.0, 2.0], [1.0, 2.0], [-3.0, 0.5]]),
            "action": torch.tensor([[0.7], [0.7], [-2.0]]),
            "dynamics_member": torch.tensor([[0], [1], [1]]),
            "dynamics_noise": torch.tensor([[1.0, -1.0], [1.0, -1.0], [0.5, 2.0]]),
        },
        [3],
    )
    expected = torch.tensor(
        [
            [1.0 + 2 * 0.7 + 0.5 * 1.0, 2.0 + 0.1 + 1.0 * -1.0],
            [1.0 + 0.3 + math.exp(0.7 - 1.0) * 1.0, 2.0 - 1.0 + 2.0 * -1.0],
            [-3.0 + 0.3 + math.exp(-2.0 - 1.0) * 0.5, 0.5 + 3.0 + 2.0 * 2.0],
        ]
    )
    torch.testing.assert_close(dynamics(td)["next", "latent"], expected)


def test_a_control_affine_step_equals_a_computation_by_hand():
    dynamics = EnsembleDynamics(2, 3, num_members=2, hidden=(), control_affine=True)
    # Outputs of member 1 at z = (1, -2): b, log sigma and the rows of A.
    drift, log_scale = torch.tensor([0.5, -1.0]), torch.tensor([math.log(0.5), math.log(2.0)])
    gain = torch.tensor([[1.0, 2.0, 3.0], [-1.0, 0.0, 4.0]])
    z, a = torch.tensor([1.0, -2.0]), torch.tensor([0.1, -0.2, 0.3])
    slope = torch.arange(10.0).reshape(10)  # every output also grows with z0
    with torch.no_grad():
        dynamics.network.weights[0].zero_()
        dynamics.network.weights[0][1, 0] = slope
        dynamics.network.biases[0][1, 0] = torch.cat([drift, log_scale, gain.flatten()]) - slope * z[0]
    noise = torch.tensor([1.0, -1.0])
    td = TensorDict({"latent": z, "action": a, "dynamics_member": torch.tensor([1]), "dynamics_noise": noise})
    expected = z + drift + gain @ a + torch.tensor([0.5, 2.0]) * noise
    torch.testing.assert_close(dynamics(td)["next", "latent"], expected)


def test_control_affine_members_see_their_own_column_alone():
    dynamics = EnsembleDynamics(3, 2, num_members=4, hidden=(8,), control_affine=True)
    latent, action = torch.randn(5, 3), torch.randn(5, 2)
    loc, scale = dynamics.distribution(latent, action)
    copies = latent[:, None].repeat(1, 4, 1), action[:, None].repeat(1, 4, 1)
    for one, other in zip(dynamics.distribution(*copies, per_member=True), (loc, scale), strict=True):
        torch.testing.assert_close(one, other)
    copies[1][:, 1] += 1.0
    moved, same_scale = dynamics.distribution(*copies, per_member=True)
    assert (moved != loc).any(0).any(-1).tolist() == [False, True, False, False]
    torch.testing.assert_close(same_scale, scale)
    # Affine: twice the action, twice the change that is due to it.
    rest, once, twice = (dynamics.distribution(latent, k * action)[0] for k in (0.0, 1.0, 2.0))
    torch.testing.assert_close(twice - rest, 2 * (once - rest))


@pytest.mark.parametrize("control_affine", [False, True])
@pytest.mark.parametrize("scale", [0.05, [0.05, 2.0]])
def test_actions_are_seen_in_their_unit(control_affine, scale):
    torch.manual_seed(1)
    plain = EnsembleDynamics(3, 2, num_members=4, hidden=(8,), control_affine=control_affine)
    torch.manual_seed(1)
    dynamics = EnsembleDynamics(3, 2, num_members=4, hidden=(8,), control_affine=control_affine, action_scale=scale)
    latent, unit = torch.randn(5, 3), torch.randn(5, 2)
    for one, other in zip(
        dynamics.distribution(latent, unit * torch.tensor(scale)), plain.distribution(latent, unit), strict=True
    ):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("scale", [0.0, -1.0, [1.0, 2.0, 3.0], [[1.0, 2.0]]])
def test_impossible_units_are_refused(scale):
    with pytest.raises(ValueError, match="action_scale must be one positive number or one for each of 2 actions"):
        EnsembleDynamics(3, 2, action_scale=scale)


def test_distribution_gives_each_members_mean_and_scale_around_the_latent():
    dynamics = EnsembleDynamics(3, 2, num_members=4, hidden=(8,))
    latent, action = torch.randn(5, 3), torch.randn(5, 2)
    loc, scale = dynamics.distribution(latent, action)
    assert loc.shape == scale.shape == (5, 4, 3)
    raw = dynamics.network(torch.cat([latent, action], -1))
    torch.testing.assert_close(loc, latent[:, None] + raw[..., :3])
    torch.testing.assert_close(scale, raw[..., 3:].exp())
    # With one copy per member the answer is the same; a change of column 1 moves member 1 alone.
    copies = latent[:, None].repeat(1, 4, 1), action[:, None].repeat(1, 4, 1)
    per_member, _ = dynamics.distribution(*copies, per_member=True)
    torch.testing.assert_close(per_member, loc)
    copies[1][:, 1] += 1.0
    moved = (dynamics.distribution(*copies, per_member=True)[0] != per_member).any(0).any(-1)
    assert moved.tolist() == [False, True, False, False]


def test_log_scale_is_clamped():
    dynamics = EnsembleDynamics(1, 1, num_members=2, hidden=(), log_scale_bounds=(-2.0, 1.0))
    with torch.no_grad():
        dynamics.network.weights[0].zero_()
        dynamics.network.biases[0][:, 0, 1] = torch.tensor([-50.0, 50.0])
    _, scale = dynamics.distribution(torch.zeros(1, 1), torch.zeros(1, 1))
    torch.testing.assert_close(scale.flatten(), torch.tensor([math.exp(-2.0), math.exp(1.0)]))


def test_sampled_noise_has_the_members_scale():
    dynamics = EnsembleDynamics(1, 1, num_members=1, hidden=())
    with torch.no_grad():
        dynamics.network.weights[0].zero_()
        dynamics.network.biases[0].copy_(torch.tensor([[[3.0, math.log(0.25)]]]))
    next_latent = dynamics(rest(20_000))["next", "latent"]
    assert next_latent.mean().item() == pytest.approx(3.0, abs=0.01)
    assert next_latent.std().item() == pytest.approx(0.25, rel=0.03)


@pytest.mark.parametrize(("rows", "members"), [(20, 5), (7, 5), (3, 5), (1, 1), (11, 2)])
def test_sample_members_splits_as_evenly_as_can_be(rows: int, members: int):
    sampled = EnsembleDynamics(1, 1, num_members=members, hidden=()).sample_members(rows)
    counts = torch.bincount(sampled, minlength=members)
    assert sampled.dtype == torch.int64
    assert counts.sum() == rows
    assert len(counts) == members
    assert counts.max() - counts.min() <= 1


def test_every_member_is_as_likely_as_another_for_a_row():
    dynamics = EnsembleDynamics(1, 1, num_members=5, hidden=())
    # With 3 rows for 5 members the remainder must rotate too, else two members would never be sampled.
    samples = torch.stack([dynamics.sample_members(3) for _ in range(2000)])
    for row in range(3):
        fraction = torch.bincount(samples[:, row], minlength=5) / 2000
        torch.testing.assert_close(fraction, torch.full((5,), 0.2), atol=0.04, rtol=0)


def test_ts1_samples_members_anew_at_every_step():
    dynamics = shifting_dynamics(5)
    td = dynamics(rest(40))
    first = members_used(td)
    assert "dynamics_member" not in td
    td = step_mdp(td).set("action", torch.zeros(40, 1))
    second = members_used(dynamics(td))
    for used in (first, second):
        assert torch.bincount(used, minlength=5).tolist() == [8] * 5
    assert not torch.equal(first, second)


def test_given_members_and_noise_make_a_step_repeatable_in_any_batch_shape():
    dynamics = EnsembleDynamics(3, 2, num_members=4, hidden=(8,))
    td = TensorDict({"latent": torch.randn(2, 6, 3), "action": torch.randn(2, 6, 2)}, [2, 6])
    td["dynamics_member"] = torch.randint(4, (2, 6, 1))
    td["dynamics_noise"] = torch.randn(2, 6, 3)
    first = dynamics(td.clone())["next", "latent"]
    assert torch.equal(dynamics(td.clone())["next", "latent"], first)
    flat = dynamics(td.clone().reshape(12))["next", "latent"]
    torch.testing.assert_close(flat.reshape(2, 6, 3), first)


def test_nested_keys():
    dynamics = EnsembleDynamics(
        3,
        2,
        num_members=4,
        hidden=(8,),
        latent_key=("model", "z"),
        action_key=("agent", "action"),
        next_latent_key=("next", "model", "z"),
        member_key=("model", "member"),
        noise_key=("model", "noise"),
    )
    latent, noise = torch.randn(6, 3), torch.randn(6, 3)
    member = torch.tensor([[0], [3], [1], [2], [3], [0]])
    td = TensorDict(
        {"model": {"z": latent, "noise": noise, "member": member}, "agent": {"action": torch.randn(6, 2)}}, [6]
    )
    dynamics(td)
    loc, scale = dynamics.distribution(latent, td["agent", "action"])
    rows = torch.arange(6)
    expected = loc[rows, member[:, 0]] + scale[rows, member[:, 0]] * noise
    torch.testing.assert_close(td["next", "model", "z"], expected)
    assert dynamics.in_keys == [("model", "z"), ("agent", "action")]


def test_missing_keys_are_named():
    dynamics = EnsembleDynamics(3, 2, hidden=(8,))
    with pytest.raises(KeyError, match=r"\['action'\].*It has: latent"):
        dynamics(TensorDict({"latent": torch.zeros(4, 3)}, [4]))


def test_bad_options_are_refused():
    with pytest.raises(ValueError, match="log_scale_bounds must rise"):
        EnsembleDynamics(3, 2, log_scale_bounds=(1.0, 1.0))
    with pytest.raises(ValueError, match="num_members must be at least 1"):
        EnsembleDynamics(3, 2, num_members=0)


@pytest.mark.parametrize("control_affine", [False, True])
@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_it_computes_in_the_dtype_it_was_moved_to(dtype: torch.dtype, control_affine: bool):
    dynamics = EnsembleDynamics(3, 2, hidden=(16,), control_affine=control_affine, action_scale=[0.5, 2.0])
    td = TensorDict(
        {"latent": torch.randn(6, 3), "action": torch.randn(6, 2), "dynamics_noise": torch.randn(6, 3)}, [6]
    )
    td["dynamics_member"] = torch.arange(6).unsqueeze(-1) % 5
    before = dynamics(td.clone())["next", "latent"]
    moved = td.apply(lambda x: x.to(dtype) if x.is_floating_point() else x)
    after = dynamics.to(dtype)(moved)["next", "latent"]
    assert after.dtype == dtype
    assert dynamics.action_scale.dtype == dtype
    tolerance = 1e-5 if dtype == torch.float64 else 0.05
    torch.testing.assert_close(after, before.to(dtype), atol=tolerance, rtol=tolerance)
    assert dynamics(moved.exclude("dynamics_noise", "dynamics_member"))["next", "latent"].dtype == dtype


def test_a_log_scale_outside_its_range_gets_the_gradient_of_soft_bounds():
    low, high = -2.0, 1.0
    dynamics = EnsembleDynamics(1, 1, num_members=1, hidden=(), log_scale_bounds=(low, high))
    for x in (-5.0, -2.5, -1.0, 0.5, 1.25, 4.0):
        output = torch.tensor([[0.0, x]], requires_grad=True)
        _, log_scale = dynamics.read_output(output, torch.zeros(1, 1))
        assert log_scale.item() == min(max(x, low), high)  # the value is clamped
        (gradient,) = torch.autograd.grad(log_scale.sum(), output)
        soft = torch.tensor(x, dtype=torch.float64, requires_grad=True)
        bounded = (
            high - torch.nn.functional.softplus(high - soft)
            if x > high
            else low + torch.nn.functional.softplus(soft - low)
        )
        (expected,) = torch.autograd.grad(bounded, soft)
        assert gradient[0, 1].item() == pytest.approx(1.0 if low <= x <= high else expected.item(), rel=1e-5)


@pytest.mark.parametrize("start", [8.0, -14.0])
def test_a_log_scale_that_has_left_its_range_comes_back(start):
    # With the gradient of a plain clamp, which is 0 there, this network would never change again.
    dynamics = EnsembleDynamics(1, 1, num_members=1, hidden=())
    with torch.no_grad():
        dynamics.network.weights[0].zero_()
        dynamics.network.biases[0].copy_(torch.tensor([[[0.0, start]]]))
    optimizer = torch.optim.Adam(dynamics.parameters(), 0.1)
    z = torch.zeros(64, 1)
    target = torch.randn(64, 1)
    for _ in range(400):
        loc, scale = dynamics.distribution(z, z)
        loss = -torch.distributions.Normal(loc.squeeze(-2), scale.squeeze(-2)).log_prob(target).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    end = dynamics.network.biases[0][0, 0, 1].item()
    assert abs(end) < 0.5 * abs(start)  # on the way to the log of the targets' standard deviation, 0
    assert dynamics.log_scale_bounds[0] < end < dynamics.log_scale_bounds[1]


@pytest.mark.parametrize(("latent", "action", "named"), [((4, 3), (4, 2), "latent"), ((4, 2), (4, 3), "action")])
def test_latents_and_actions_of_another_size_are_refused_by_name(latent, action, named):
    dynamics = EnsembleDynamics(2, 2, num_members=2, hidden=(4,))
    td = TensorDict({"latent": torch.zeros(latent), "action": torch.zeros(action)}, [4])
    with pytest.raises(ValueError, match=rf"EnsembleDynamics reads '{named}' of shape \[\*B, 2\], got \[4, 3\]"):
        dynamics(td)
