"""MujocoEnv: freezing, blow-ups, seeds, and one picture for several questions."""

import pytest
import torch
from torchrl.envs import step_mdp
from torchrl.envs.utils import check_env_specs

from ls3_envs import CableRoutingEnv, ReacherEnv, SequentialPushingEnv

DOMAINS = [ReacherEnv, SequentialPushingEnv, CableRoutingEnv]


def play(env, steps=4, seed=3):
    """Random actions whose first rows do not depend on the number of worlds."""
    generator, td, out = torch.Generator().manual_seed(seed), env.reset(), []
    space = env.action_spec.space
    for _ in range(steps):
        draws = torch.rand(4, 2, generator=generator)[: env.num_envs]
        td = env.step(td.set("action", space.low + (space.high - space.low) * draws))
        out.append(td)
        td = step_mdp(td)
    return torch.stack(out, 1)


@pytest.mark.parametrize("domain", DOMAINS)
def test_specs(domain):
    check_env_specs(domain(num_envs=2, seed=0))


@pytest.mark.parametrize("domain", DOMAINS)
def test_the_same_seed_gives_the_same_bits_whatever_the_batch_and_threads(domain):
    whole = play(domain(num_envs=4, threads=1, seed=5))
    few = play(domain(num_envs=2, threads=2, seed=5))
    for key in ("state", "pixels", "constraint", "success"):
        assert torch.equal(few["next", key], whole["next", key][:2]), key
    assert not torch.equal(play(domain(num_envs=2, seed=6))["state"], few["state"]) or domain is ReacherEnv


def test_warp_physics_lives_almost_the_same_life():
    exact, warp = (play(ReacherEnv(num_envs=2, physics=name, seed=0), steps=8) for name in ("mujoco", "warp"))
    torch.testing.assert_close(warp["next", "state"], exact["next", "state"], atol=1e-4, rtol=1e-3)


def test_a_blow_up_ends_one_worlds_episode_and_no_others():
    env, other = (ReacherEnv(num_envs=3, seed=0) for _ in range(2))
    td, same = env.reset(), other.reset()
    zero = torch.zeros(3, 2)
    env._state[1, 2] = 1e9  # a speed that no arm has
    broken, fine = (e.step(t.set("action", zero))["next"] for e, t in ((env, td), (other, same)))
    assert broken["physics_error"].flatten().tolist() == [False, True, False]
    assert broken["truncated"].flatten().tolist() == [False, True, False]
    assert broken["done"].flatten().tolist() == [False, True, False]
    assert not broken["terminated"].any()
    assert torch.equal(broken["state"][[0, 2]], fine["state"][[0, 2]])
    assert broken["pixels"].shape == fine["pixels"].shape
    # A reset of that world brings it back.
    mask = torch.tensor([[False], [True], [False]])
    again = env.reset(broken.clone().set("_reset", mask))
    assert not again["physics_error"].any()
    assert not env.step(again.set("action", zero))["next", "physics_error"].any()


def test_a_nan_state_goes_back_to_the_last_good_one():
    env = ReacherEnv(num_envs=2, seed=0)
    td = env.reset()
    good = env._state.clone()
    env.physics = lambda state, control: torch.where(torch.tensor([[True], [False]]), torch.nan, state)
    out = env.step(td.set("action", torch.zeros(2, 2)))["next"]
    assert torch.equal(env._state, good)
    assert out["state"].isfinite().all()
    assert out["physics_error"].flatten().tolist() == [True, False]


def test_a_violation_freezes_the_world():
    env = ReacherEnv(num_envs=2, seed=0)
    td = env.reset()

    env._state[0] = on_the_obstacle()
    td = env.step(td.set("action", torch.zeros(2, 2)))
    assert td["next", "constraint"].flatten().tolist() == [True, False]
    later = env.step(step_mdp(td).set("action", torch.ones(2, 2)))
    assert torch.equal(later["next", "state"][0], td["next", "state"][0])
    assert not torch.equal(later["next", "state"][1], td["next", "state"][1])
    assert later["next", "reward"].flatten().tolist() == [-1.0, -1.0]


def on_the_obstacle() -> torch.Tensor:
    from ls3_envs.reacher import OBSTACLE, finger_position

    angles = torch.rand(20_000, 2, dtype=torch.float64) * 2 * torch.pi - torch.pi
    states = torch.cat([angles, torch.zeros_like(angles)], -1)
    distance = (finger_position(states) - torch.tensor(OBSTACLE, dtype=torch.float64)).norm(dim=-1)
    return states[distance.argmin()]


def test_one_picture_is_drawn_for_all_questions_about_a_state():
    env = CableRoutingEnv(num_envs=1, seed=0)
    draw, calls = env.renderer, []
    env.renderer = lambda qpos: (calls.append(1), draw(qpos))[1]
    td = env.reset()
    calls.clear()
    env.step(td.set("action", torch.full((1, 2), 0.01)))
    assert len(calls) == 1


def test_stepping_before_the_first_reset_is_refused():
    env = ReacherEnv(num_envs=1, seed=0)
    with pytest.raises(RuntimeError, match=r"before its first reset.*env\.reset\(\)"):
        env._step(env.fake_tensordict())


def test_actions_of_another_shape_are_refused():
    env = ReacherEnv(num_envs=2, seed=0)
    td = env.reset()
    with pytest.raises(ValueError, match=r"shape \[2, 2\], one row for each environment; got \[2, 3\]"):
        env.step(td.set("action", torch.zeros(2, 3)))
