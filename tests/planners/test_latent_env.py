import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Unbounded
from torchrl.envs import check_env_specs

from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator
from ls3_torchrl.planners import LatentEnv

D, A, M = 4, 2, 3
SPEC = Bounded(low=-1.0, high=1.0, shape=(A,))


def linear_judge(kind, slope, offset):
    """Logit = slope * (z_0 - offset)."""
    judge = kind(D, hidden=())
    with torch.no_grad():
        judge.network[-1].weight.zero_()[0, 0] = slope
        judge.network[-1].bias.fill_(-slope * offset)
    return judge


def linear_world(propagation="ts1", scale=0.5):
    """Member m moves z by (m + 1) * (a_0, a_1, 0, 0) with standard deviation ``scale``."""
    dynamics = EnsembleDynamics(D, A, num_members=M, hidden=(), propagation=propagation)
    with torch.no_grad():
        dynamics.network.weights[0].zero_()
        dynamics.network.biases[0].zero_()[..., D:] = math.log(scale)
        for m in range(M):
            for i in range(A):
                dynamics.network.weights[0][m, D + i, i] = m + 1.0
    return LatentEnv(
        dynamics, linear_judge(ConstraintEstimator, 2.0, 1.0), linear_judge(GoalEstimator, 4.0, 3.0), action_spec=SPEC
    )


def test_one_step_by_hand():
    env = linear_world()
    start = env.reset(TensorDict({"latent": torch.tensor([[1.0, 0.0, 0.0, 2.0], [2.0, 0.0, 0.0, 0.0]])}, [2]))
    # f_C looks at where the particle stands from the first state on.
    torch.testing.assert_close(start["constraint_prob"].flatten(), torch.tensor([0.0, 2.0]).sigmoid())
    start["action"] = torch.tensor([[0.5, -1.0], [1.0, 0.0]])
    start["dynamics_member"] = torch.tensor([[0], [2]])
    start["dynamics_noise"] = torch.tensor([[0.0, 0.0, 0.0, 2.0], [-2.0, 0.0, 0.0, 0.0]])
    after = env.step(start)["next"]
    # z + (m + 1) a + 0.5 noise
    expected = torch.tensor([[1.5, -1.0, 0.0, 3.0], [4.0, 0.0, 0.0, 0.0]])
    torch.testing.assert_close(after["latent"], expected)
    torch.testing.assert_close(after["constraint_prob"].flatten(), torch.tensor([1.0, 6.0]).sigmoid())
    torch.testing.assert_close(after["goal_prob"].flatten(), torch.tensor([-6.0, 4.0]).sigmoid())
    assert after["reward"].flatten().tolist() == [-1.0, 0.0]
    assert not after["done"].any()


def test_specs_hold():
    torch.manual_seed(0)
    for propagation in ("ts1", "tsinf"):
        env = linear_world(propagation)
        check_env_specs(env, tensordict=env.reset(TensorDict({"latent": torch.zeros(3, D)}, [3])))


@pytest.mark.parametrize("batch", [[], [1], [5], [2, 3], [2, 3, 4]])
def test_any_batch_size_goes(batch):
    env = linear_world()
    start = env.reset(TensorDict({"latent": torch.zeros(*batch, D)}, batch))
    path = env.rollout(2, auto_reset=False, tensordict=start)
    assert path["next", "latent"].shape == (*batch, 2, D)
    for key in ("reward", "constraint_prob", "goal_prob"):
        assert path["next", key].shape == (*batch, 2, 1)


def test_it_never_ends_an_episode():
    env = linear_world()
    # Deep in the goal and the constraint at once.
    start = env.reset(TensorDict({"latent": torch.full((2, D), 50.0)}, [2]))
    path = env.rollout(4, auto_reset=False, tensordict=start)
    assert path.shape == (2, 4)
    assert not path["next", "done"].any()


def test_ts_infinity_keeps_each_particles_member():
    torch.manual_seed(0)
    env = linear_world("tsinf")
    start = env.reset(TensorDict({"latent": torch.zeros(30, D)}, [30]))
    path = env.rollout(6, auto_reset=False, tensordict=start)
    member = path["next", "dynamics_member"].squeeze(-1)
    assert (member == member[:, :1]).all()
    assert torch.equal(member[:, 0], start["dynamics_member"].flatten())
    assert torch.bincount(member[:, 0], minlength=M).tolist() == [10, 10, 10]


def test_ts_infinity_really_moves_by_that_member():
    env = linear_world("tsinf", scale=1e-3)
    start = TensorDict({"latent": torch.zeros(3, D), "dynamics_member": torch.tensor([[0], [1], [2]])}, [3])
    path = env.rollout(
        4,
        lambda td: td.set("action", torch.tensor([[1.0, 0.0]]).expand(3, -1)),
        auto_reset=False,
        tensordict=env.reset(start),
    )
    torch.testing.assert_close(path["next", "latent"][:, -1, 0], torch.tensor([4.0, 8.0, 12.0]), atol=0.05, rtol=0)


def test_ts1_changes_members_on_the_way():
    torch.manual_seed(0)
    env = linear_world("ts1", scale=1e-3)
    start = env.reset(TensorDict({"latent": torch.zeros(30, D)}, [30]))
    path = env.rollout(
        6,
        lambda td: td.set("action", torch.ones(30, A)),
        auto_reset=False,
        tensordict=start,
    )
    places = torch.cat([path["latent"][:, :1, 0], path["next", "latent"][..., 0]], 1)
    member = places.diff(dim=1).round()
    # Each step has an even split, but no particle of these thirty keeps one member throughout.
    assert [(member == m).sum(0).tolist() for m in (1, 2, 3)] == [[10] * 6] * 3
    assert (member != member[:, :1]).any(1).all()


def test_reset_needs_a_latent():
    with pytest.raises(KeyError, match="latent to start from"):
        linear_world().reset()
    with pytest.raises(KeyError, match=r"LatentEnv.reset needs the keys \['latent'\]"):
        linear_world().reset(TensorDict({"state": torch.zeros(2, D)}, [2]))


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (Unbounded(shape=(A,)), "bounded action spec, got Unbounded"),
        (Bounded(low=-1.0, high=1.0, shape=(5, A)), r"must have shape \[2\].*got \[5, 2\].*one row"),
        (Bounded(low=-1.0, high=1.0, shape=(3,)), r"must have shape \[2\].*got \[3\]"),
    ],
)
def test_action_specs_that_cannot_be_planned_with_are_refused(spec, message):
    with pytest.raises(ValueError, match=message):
        LatentEnv(EnsembleDynamics(D, A), ConstraintEstimator(D), GoalEstimator(D), action_spec=spec)
