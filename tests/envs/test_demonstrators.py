"""The scripted policies keep the promises that the offline data rest on."""

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import InitTracker, TransformedEnv

from ls3_envs import NavigationDemonstrator, NavigationEnv, NavigationViolator, collect_offline
from ls3_envs.demonstrators import collect_episodes


@pytest.fixture(scope="module")
def demonstrations() -> TensorDictBase:
    return collect_offline("navigation", "success", seed=0).exclude("pixels", ("next", "pixels"))


@pytest.fixture(scope="module")
def violations() -> TensorDictBase:
    return collect_offline("navigation", "constraint", seed=0).exclude("pixels", ("next", "pixels"))


def test_fifty_demonstrations_all_succeed_and_none_violates(demonstrations: TensorDictBase):
    assert demonstrations.batch_size == (50, 100)
    assert demonstrations["next", "success"].any(dim=1).all()
    assert not demonstrations["next", "constraint"].any()


def test_demonstrations_are_suboptimal(demonstrations: TensorDictBase):
    # 20 steps north and 40 east before the goal is aimed at: about twice the 40 steps of the best way.
    returns = demonstrations["next", "reward"].sum(dim=1)
    assert -90 < returns.mean().item() < -78
    assert returns.max().item() < -60


def test_demonstrations_go_north_then_east_then_to_the_goal(demonstrations: TensorDictBase):
    state = demonstrations["next", "state"].mean(0)
    assert state[19, 1] < 28  # north is up, and y grows downwards; the noise costs a little of the speed
    assert abs(state[19, 0] - 30) < 3
    assert state[59, 0] > 120
    assert state[59, 1] < 25
    assert (state[-1] - torch.tensor([150.0, 75.0])).norm() < 3


def test_all_fifty_violators_violate_and_none_starts_in_the_wall(violations: TensorDictBase):
    assert violations.batch_size == (50, 100)
    assert not violations["constraint"][:, 0].any()
    assert violations["next", "constraint"][:, -1].all()
    # Once violated, always violated: the world is frozen.
    flags = violations["next", "constraint"][..., 0].int()
    assert (flags.diff(dim=1) >= 0).all()


def test_violators_move_in_one_direction_for_15_steps_and_then_towards_the_wall():
    env = TransformedEnv(NavigationEnv(num_envs=50, start="random", seed=0), InitTracker())
    episodes = collect_episodes(env, NavigationViolator(noise_std=0.0, seed=0))
    actions = episodes["action"][:, :15]
    assert torch.equal(actions, actions[:, :1].expand_as(actions))
    torch.testing.assert_close(actions[:, 0].norm(dim=-1), torch.full((50,), 3.0))
    assert not torch.equal(actions[0, 0], actions[1, 0])
    # Afterwards at half speed towards the wall's centre.
    later = episodes["action"][:, 15]
    towards = torch.tensor([87.5, 75.0]) - episodes["state"][:, 15]
    expected = 1.5 * towards / towards.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(later, expected, atol=1e-4, rtol=1e-4)


def test_violators_are_as_noisy_as_the_demonstrator_unless_told_otherwise(violations: TensorDictBase):
    # The dynamics must see more than two actions an episode.
    assert NavigationViolator().noise_std == NavigationDemonstrator().noise_std
    changes = violations["action"][:, 1:15] - violations["action"][:, :14]
    assert (changes.abs().sum(-1) > 0).float().mean() > 0.9


def test_actions_stay_in_the_box(demonstrations: TensorDictBase, violations: TensorDictBase):
    for episodes in (demonstrations, violations):
        assert episodes["action"].abs().max() <= 3.0


def test_noise_of_the_demonstrator():
    def action_at_start(noise_std: float, seed: int) -> torch.Tensor:
        # East of the way's first goal, where the noiseless action is (-1, 0): the clamp at 3 is 3 deviations off.
        state = torch.tensor([[31.0, 15.0]]).expand(5000, 2)
        td = TensorDict({"state": state, "is_init": torch.ones(5000, 1, dtype=torch.bool)}, [5000])
        return NavigationDemonstrator(noise_std=noise_std, seed=seed)(td)["action"]

    assert torch.equal(action_at_start(0.0, 0), torch.tensor([[-1.0, 0.0]]).expand(5000, 2))
    noisy = action_at_start(0.5, 0)
    torch.testing.assert_close(noisy.mean(0), torch.tensor([-1.0, 0.0]), atol=0.03, rtol=0)
    torch.testing.assert_close(noisy.std(0), torch.full((2,), 0.5), atol=0.02, rtol=0)
    assert torch.equal(action_at_start(0.5, 0), noisy)
    assert not torch.equal(action_at_start(0.5, 1), noisy)


def test_the_script_restarts_with_each_world():
    # World 0 is reset after 25 steps and heads north again while world 1 goes on east.
    policy = NavigationDemonstrator(noise_std=0.0)
    state = torch.tensor([[30.0, 60.0], [30.0, 60.0]])
    for t in range(26):
        is_init = torch.tensor([[t in (0, 25)], [t == 0]])
        action = policy(TensorDict({"state": state, "is_init": is_init}, [2]))["action"]
    assert action.tolist() == [[0.0, -3.0], [3.0, -3.0]]


def test_collect_episodes_runs_every_world_to_its_horizon():
    env = TransformedEnv(NavigationEnv(num_envs=2, horizon=7, seed=0), InitTracker())
    episodes = collect_episodes(env, NavigationDemonstrator(seed=0))
    assert episodes.batch_size == (2, 7)
    assert not episodes["action"].requires_grad
    assert episodes["next", "truncated"][:, -1].all()


@pytest.mark.parametrize("policy", [NavigationDemonstrator, NavigationViolator])
def test_negative_noise_is_refused(policy: type):
    with pytest.raises(ValueError, match=r"noise_std must not be negative, got -0\.1"):
        policy(noise_std=-0.1)
