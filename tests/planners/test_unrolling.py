"""Particles carried by a snapshot: grouped by member, from shared latents, with and without noise."""

import pytest
import torch
from torchrl.data import Bounded

from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator, SafeSet, ValueEnsemble
from ls3_torchrl.planners import FusedImagination, ImaginationNoise, LatentEnv, RolloutImagination
from ls3_torchrl.planners import fused as fused_module
from ls3_torchrl.planners.fused import _in_threads
from ls3_torchrl.planners.unrolling import group_by_member

D, A, M, B, N, H = 4, 3, 3, 3, 7, 4


def both(*, control_affine, block=None, hidden=(8,)):
    torch.manual_seed(0)
    env = LatentEnv(
        EnsembleDynamics(
            D, A, num_members=M, hidden=hidden, control_affine=control_affine, action_scale=[0.5, 1.0, 2.0]
        ),
        ConstraintEstimator(D, hidden=(8,)),
        GoalEstimator(D, hidden=(8,)),
        action_spec=Bounded(low=-1.0, high=1.0, shape=(A,)),
    )
    heads = ValueEnsemble(D, num_members=2, hidden=(8,)), SafeSet(D, hidden=(8,))
    return FusedImagination(env, *heads, precision="fp32", block=block), RolloutImagination(env, *heads)


def test_particles_are_put_together_by_member_and_back():
    members = torch.tensor([[2, 0, 2, 1], [1, 1, 1, 1]])
    first, second = group_by_member(members)
    assert members[0][first.sorted].tolist() == [0, 1, 2, 2]
    assert first.sorted[first.back].tolist() == [0, 1, 2, 3]
    assert first.members == [(0, 1), (1, 1), (2, 2)]
    assert second.members == [(1, 4)]
    assert second.sorted.tolist() == second.back.tolist() == [0, 1, 2, 3]


# As many for each member; as many for two of three, which is no product of all; uneven; one member alone.
@pytest.mark.parametrize("members", [[0, 1, 2, 2, 0, 1], [0, 1, 1, 0], [2, 2, 0, 1, 2], [1, 1]])
@pytest.mark.parametrize("control_affine", [False, True])
@pytest.mark.parametrize("scale", [0.0, 1.0], ids=["without noise", "with noise"])
@pytest.mark.parametrize("block", [None, 4 * len("plans")], ids=["whole", "parts that hold pieces of rows"])
def test_it_is_what_the_environment_imagines(members, control_affine, scale, block):
    fused, plain = both(control_affine=control_affine, block=block)
    torch.manual_seed(1)
    steps = torch.stack([torch.tensor(members).roll(t) for t in range(H)])
    noise = ImaginationNoise(steps, scale * torch.randn(B, H, len(members), D))
    latent, actions = torch.randn(B, D), torch.rand(B, N, H, A) * 2 - 1
    for name, one, other in zip(
        plain(latent, actions, noise)._fields,
        fused(latent, actions, noise),
        plain(latent, actions, noise),
        strict=True,
    ):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5, msg=name)


@pytest.mark.parametrize("workers", [1, 2, 3])
@pytest.mark.parametrize("plans", [1, 2, 5, 100, 1000])
@pytest.mark.parametrize("particles", [1, 5, 20])
def test_parts_hold_every_plan_once_and_no_more_than_a_block(workers, plans, particles, monkeypatch):
    monkeypatch.setattr(fused_module, "_SMALLEST_PART", 50)
    imagine, _ = both(control_affine=False, block=400)
    parts = imagine._parts(plans, particles, workers, on_cpu=True)
    assert [i for part in parts for i in range(plans)[part]] == list(range(plans))
    sizes = [part.stop - part.start for part in parts]
    assert max(sizes) * particles <= 400
    if workers == 2 and plans * particles >= 50 * workers:
        assert len(parts) % workers == 0  # no core waits for another's last block
    if plans * particles < 50 * 2 and workers > 1:
        assert len(parts) == 1


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_results_come_in_order_and_errors_come_through(workers):
    threads = torch.get_num_threads()

    def job(i):
        if i == 7:
            raise KeyError(i)
        return i * i

    assert _in_threads(job, range(7), workers) == [0, 1, 4, 9, 16, 25, 36]
    with pytest.raises(KeyError):
        _in_threads(job, range(9), workers)
    assert _in_threads(job, range(2), workers) == [0, 1]
    torch.set_num_threads(threads)
