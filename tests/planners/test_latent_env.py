import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Unbounded
from torchrl.envs import StepCounter, TransformedEnv, check_env_specs

from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator
from ls3_torchrl.planners import LatentEnv

D, A, M = 4, 2, 3
SPEC = Bounded(low=-1.0, high=1.0, shape=(A,))


def linear_classifier(kind, slope, offset):
    """Logit = slope * (z_0 - offset)."""
    module = kind(D, hidden=())
    with torch.no_grad():
        module.network[-1].weight.zero_()[0, 0] = slope
        module.network[-1].bias.fill_(-slope * offset)
    return module


def linear_world(scale=0.5):
    """Member m moves z by (m + 1) * (a_0, a_1, 0, 0) with standard deviation ``scale``."""
    dynamics = EnsembleDynamics(D, A, num_members=M, hidden=())
    with torch.no_grad():
        dynamics.network.weights[0].zero_()
        dynamics.network.biases[0].zero_()[..., D:] = math.log(scale)
        for m in range(M):
            for i in range(A):
                dynamics.network.weights[0][m, D + i, i] = m + 1.0
    return LatentEnv(
        dynamics,
        linear_classifier(ConstraintEstimator, 2.0, 1.0),
        linear_classifier(GoalEstimator, 4.0, 3.0),
        action_spec=SPEC,
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
    env = linear_world()
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


def test_ts1_changes_members_on_the_way():
    torch.manual_seed(0)
    env = linear_world(scale=1e-3)
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


@pytest.mark.parametrize("batch", [[], [0], [500], [2, 300]])
def test_without_a_latent_reset_draws_from_the_prior(batch):
    torch.manual_seed(0)
    env = linear_world()
    start = env.reset(TensorDict({}, batch))
    assert start["latent"].shape == (*batch, D)
    assert start["constraint_prob"].shape == start["goal_prob"].shape == (*batch, 1)
    if start["latent"].numel() > 1000:  # the prior that the VAE is trained towards
        assert abs(start["latent"].mean()) < 0.1
        assert abs(start["latent"].std() - 1.0) < 0.1
    assert env.reset().batch_size == torch.Size([])
    assert env.reset()["latent"].shape == (D,)


def test_a_reset_of_some_rows_draws_those_alone():
    torch.manual_seed(0)
    env = linear_world()
    before = env.reset(TensorDict({"latent": torch.full((3, D), 50.0)}, [3]))
    after = env.reset(before.set("_reset", torch.tensor([[True], [False], [True]])))
    assert (after["latent"][1] == 50.0).all()
    assert (after["latent"][[0, 2]].abs() < 10.0).all()
    torch.testing.assert_close(after["goal_prob"], (4.0 * (after["latent"][:, :1] - 3.0)).sigmoid())


def test_episodes_cut_by_a_step_counter_begin_anew():
    torch.manual_seed(0)
    env = TransformedEnv(linear_world(), StepCounter(max_steps=3))
    path = env.rollout(7, tensordict=env.reset(TensorDict({}, [2])), auto_reset=False, break_when_any_done=False)
    assert path["step_count"][0].flatten().tolist() == [0, 1, 2, 0, 1, 2, 0]
    torch.testing.assert_close(path["latent"][:, 1:3], path["next", "latent"][:, :2])
    assert not torch.isclose(path["latent"][:, 3], path["next", "latent"][:, 2]).any()


def test_a_tensordict_that_has_no_latent_among_its_entries_is_refused():
    with pytest.raises(ValueError, match=r"reset found state, but no latent to start from under 'latent'.*N\(0, 1\)"):
        linear_world().reset(TensorDict({"state": torch.zeros(2, D)}, [2]))


KEYS = {"latent_key": ("see", "z"), "action_key": ("agent", "u"), "next_latent_key": ("model", "following")}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16])
@pytest.mark.parametrize("keys", [{}, {"action_key": "u"}, KEYS], ids=["default", "action", "nested"])
def test_specs_hold_for_any_keys_and_dtypes(keys, dtype):
    dynamics = EnsembleDynamics(D, A, member_key=("model", "member"), **keys)
    spec = Bounded(low=-1.0, high=1.0, shape=(A,), dtype=dtype)
    modules = [dynamics, ConstraintEstimator(D, latent_key="x"), GoalEstimator(D, latent_key=("y", "z"))]
    for parts in (modules, [module.to(torch.float64) for module in modules]):
        env = LatentEnv(
            *parts, action_spec=spec, constraint_prob_key=("c", "p"), goal_prob_key="g", reward_key=("r", "w")
        )
        check_env_specs(env)
        check_env_specs(env, tensordict=env.reset(TensorDict({}, [3])))
        path = env.rollout(2, auto_reset=False, tensordict=env.reset(TensorDict({}, [3])))
        assert path[keys.get("latent_key", "latent")].dtype == env.latent_dtype == next(dynamics.parameters()).dtype
        assert path[keys.get("action_key", "action")].dtype == dtype
        assert path["next", "r", "w"].shape == path["next", "c", "p"].shape == path["g"].shape == (3, 2, 1)


def test_a_latent_under_the_dynamics_own_key_moves_as_under_the_usual_one():
    torch.manual_seed(0)
    plain = linear_world()
    dynamics = EnsembleDynamics(D, A, num_members=M, hidden=(), **KEYS)
    dynamics.load_state_dict(plain.dynamics.state_dict())
    named = LatentEnv(dynamics, plain.constraint, plain.goal, action_spec=SPEC)
    noise = {"dynamics_member": torch.tensor([[0], [2]]), "dynamics_noise": torch.randn(2, D)}
    latent, action = torch.randn(2, D), torch.rand(2, A)
    one = plain.step(plain.reset(TensorDict({"latent": latent}, [2])).update({"action": action, **noise}))["next"]
    start = named.reset(TensorDict({"see": {"z": latent}}, [2]))
    two = named.step(start.update({"agent": {"u": action}, **noise}))["next"]
    assert torch.equal(one["latent"], two["see", "z"])
    for key in ("constraint_prob", "goal_prob", "reward"):
        assert torch.equal(one[key], two[key])


class Mover(nn.Module):
    def forward(self, latent, action):
        return latent + torch.cat([action, action], -1), action


def test_modules_from_elsewhere_need_only_their_keys():
    dynamics = TensorDictModule(Mover(), ["z", "u"], ["following", "debris"])
    classifiers = [TensorDictModule(nn.Linear(D, 1), ["x"], [key]) for key in ("bad", "good")]
    env = LatentEnv(dynamics, *classifiers, action_spec=SPEC, latent_dim=D)
    check_env_specs(env)
    start = env.reset(TensorDict({"z": torch.randn(5, D)}, [5]))
    path = env.rollout(3, auto_reset=False, tensordict=start)
    change = torch.cat([path["u"], path["u"]], -1)
    torch.testing.assert_close(path["next", "z"], path["z"] + change)
    torch.testing.assert_close(path["next", "goal_prob"], classifiers[1].module(path["next", "z"]).sigmoid())
    assert "debris" not in path["next"].keys()  # noqa: SIM118
    with pytest.raises(ValueError, match="TensorDictModule does not say how large its latents are: give latent_dim"):
        LatentEnv(dynamics, *classifiers, action_spec=SPEC)


def test_a_classifier_speaks_for_itself():
    class Doubtful(ConstraintEstimator):
        def probability(self, latent):
            return torch.full_like(latent[..., :1], 0.25)

    class Shifted(GoalEstimator):
        def forward(self, tensordict):
            super().forward(tensordict)
            return tensordict.set(self.out_keys[0], tensordict.get(self.out_keys[0]) + 100.0)

    env = LatentEnv(EnsembleDynamics(D, A), Doubtful(D), Shifted(D), action_spec=SPEC)
    path = env.rollout(2, auto_reset=False, tensordict=env.reset(TensorDict({}, [3])))
    assert (path["next", "constraint_prob"] == 0.25).all()
    assert (path["next", "goal_prob"] == 1.0).all()
    assert (path["next", "reward"] == 0.0).all()


def test_it_imagines_where_its_dynamics_are_if_nothing_else_is_said():
    dynamics = EnsembleDynamics(D, A).to("meta")
    env = LatentEnv(dynamics, ConstraintEstimator(D), GoalEstimator(D), action_spec=SPEC)
    assert env.device.type == next(env.goal.parameters()).device.type == env.action_spec.device.type == "meta"


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (Unbounded(shape=(A,)), "need a bounded spec, got Unbounded"),
        (Bounded(low=-1.0, high=1.0, shape=(5, A)), r"must have shape \[2\].*got \[5, 2\].*one row"),
        (Bounded(low=-1.0, high=1.0, shape=(3,)), r"must have shape \[2\].*got \[3\]"),
        (Bounded(low=-1, high=1, shape=(A,), dtype=torch.int64), "floating dtype, got torch.int64"),
    ],
)
def test_action_specs_that_cannot_be_planned_with_are_refused(spec, message):
    with pytest.raises(ValueError, match=message):
        LatentEnv(EnsembleDynamics(D, A), ConstraintEstimator(D), GoalEstimator(D), action_spec=spec)
