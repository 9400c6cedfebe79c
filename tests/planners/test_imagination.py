import itertools

import torch
from torchrl.data import Bounded

from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator, SafeSet, ValueEnsemble
from ls3_torchrl.planners import FusedImagination, ImaginationNoise, LatentEnv, RolloutImagination
from ls3_torchrl.planners.imagination import sample_imagination_noise

D, A, M = 4, 2, 3
B, N, H, P = 2, 6, 3, 5


def modules(num_members=M):
    torch.manual_seed(0)
    env = LatentEnv(
        EnsembleDynamics(D, A, num_members=num_members, hidden=(8,)),
        ConstraintEstimator(D, hidden=(8,)),
        GoalEstimator(D, hidden=(8,)),
        action_spec=Bounded(low=-1.0, high=1.0, shape=(A,)),
    )
    return env, ValueEnsemble(D, num_members=2, hidden=(8,)), SafeSet(D, hidden=(8,))


def problem():
    env, *_ = modules()
    torch.manual_seed(1)
    noise = sample_imagination_noise(env, B, H, P)
    return 2 * torch.randn(B, D), torch.rand(B, N, H, A) * 2 - 1, noise


def particle_by_particle(env, value, safe_set, latent, actions, noise, safe_reduction="mean", whole=False):
    """The definition, one particle of one plan at a time."""
    shapes = [(B, N, P, 2), (B, N, P, H), (B, N, P, H), (B, N, P)]
    values, goals, constraints, safe = (torch.zeros(shape) for shape in shapes)
    with torch.no_grad():
        for b, n, p in itertools.product(range(B), range(N), range(P)):
            z = latent[b]
            for t in range(H):
                loc, scale = env.dynamics.distribution(z, actions[b, n, t])
                member = noise.members[t, p]
                z = loc[member] + scale[member] * noise.noise[b, t, p]
                goals[b, n, p, t] = env.goal.probability(z).squeeze()
                constraints[b, n, p, t] = env.constraint.probability(z).squeeze()
            values[b, n, p] = value.network(z).squeeze(-1)
            safe[b, n, p] = safe_set.probability(z).squeeze()
    if whole:
        return constraints
    return values.mean(2), goals.mean(2), constraints.amax(2), safe.amin(2) if safe_reduction == "min" else safe.mean(2)


def test_rollout_imagination_follows_the_definition():
    env, value, safe_set = modules()
    latent, actions, noise = problem()
    imagine = RolloutImagination(env, value, safe_set)
    expected = particle_by_particle(env, value, safe_set, latent, actions, noise)
    for name, got, want in zip(
        imagine(latent, actions, noise)._fields, imagine(latent, actions, noise), expected, strict=True
    ):
        torch.testing.assert_close(got, want, atol=1e-5, rtol=1e-4, msg=name)


def test_the_fused_engine_gives_the_same_statistics():
    env, value, safe_set = modules()
    latent, actions, noise = problem()
    plain = RolloutImagination(env, value, safe_set)(latent, actions, noise)
    fused = FusedImagination(env, value, safe_set, precision="fp32")
    for name, got, want in zip(plain._fields, fused(latent, actions, noise), plain, strict=True):
        torch.testing.assert_close(got, want, atol=1e-4, rtol=1e-4, msg=name)


def test_every_particle_must_end_in_the_safe_set_under_min():
    env, value, safe_set = modules()
    latent, actions, noise = problem()
    expected = particle_by_particle(env, value, safe_set, latent, actions, noise, "min")[-1]
    for engine in (RolloutImagination, FusedImagination):
        options = {"precision": "fp32"} if engine is FusedImagination else {}
        imagine = engine(env, value, safe_set, safe_set_reduction="min", **options)
        got = imagine(latent, actions, noise).safe_set_prob
        torch.testing.assert_close(got, expected, atol=1e-4, rtol=1e-4)
    mean = RolloutImagination(env, value, safe_set)(latent, actions, noise).safe_set_prob
    assert (expected < mean - 1e-3).any()


def test_members_make_a_difference():
    # Otherwise the comparisons above would show little.
    env, value, safe_set = modules()
    latent, actions, noise = problem()
    expected = particle_by_particle(env, value, safe_set, latent, actions, noise)
    whole = particle_by_particle(env, value, safe_set, latent, actions, noise, whole=True)
    assert (expected[2] > whole.mean(2) + 0.01).any()  # the largest over particles is not the mean
    other = ImaginationNoise((noise.members + 1) % M, noise.noise)
    imagine = RolloutImagination(env, value, safe_set)
    assert not torch.allclose(imagine(latent, actions, noise).value, imagine(latent, actions, other).value, atol=1e-3)


def test_equal_plans_are_rated_equally_since_their_noise_is_the_same():
    env, value, safe_set = modules()
    latent, actions, noise = problem()
    same = actions[:, :1].expand(-1, N, -1, -1)
    for field in RolloutImagination(env, value, safe_set)(latent, same, noise):
        torch.testing.assert_close(field, field[:, :1].expand_as(field))


def test_imagining_leaves_no_gradients_and_draws_nothing():
    env, value, safe_set = modules()
    latent, actions, noise = problem()
    before = torch.get_rng_state()
    statistics = RolloutImagination(env, value, safe_set)(latent, actions, noise)
    assert not any(field.requires_grad for field in statistics)
    assert torch.equal(before, torch.get_rng_state())


def sampled_members(num_members, horizon, particles):
    env, *_ = modules(num_members)
    torch.manual_seed(0)
    return sample_imagination_noise(env, 1, horizon, particles).members


def test_members_split_the_particles_evenly_and_anew_at_each_step():
    torch.manual_seed(0)
    members = sampled_members(5, 200, 20)
    assert members.shape == (200, 20)
    assert all(torch.bincount(step, minlength=5).tolist() == [4] * 5 for step in members)
    # Each particle meets each member: 200 steps, 40 expected, deviation 5.7.
    met = torch.stack([torch.bincount(path, minlength=5) for path in members.T])
    assert (met - 40).abs().max() < 5 * 5.7


def test_an_uneven_split_differs_by_one_and_favours_nobody():
    torch.manual_seed(0)
    members = sampled_members(3, 600, 4)
    counts = torch.stack([torch.bincount(step, minlength=3) for step in members])
    assert counts.min() == 1
    assert counts.max() == 2
    # The member that gets the odd particle: 200 of 600 each, deviation 11.5.
    assert ((counts == 2).sum(0) - 200).abs().max() < 5 * 11.5
