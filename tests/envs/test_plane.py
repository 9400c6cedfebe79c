"""What pictures draw on, for every domain that has a plane."""

import pytest
import torch

import ls3_envs
from ls3_envs import Circle, Plane, Rectangle

ENVS = {name: ls3_envs.make(name, seed=0).base_env for name in ls3_envs.DOMAINS}
PLANES = {name: env for name, env in ENVS.items() if env.plane() is not None}


def test_navigation_has_one_and_no_mujoco_domain_does():
    assert list(PLANES) == ["navigation"]


def test_positions_are_the_two_entries_that_the_plane_names():
    plane = Plane(torch.zeros(2, 3, 4), (0.0, 1.0, 0.0, 1.0), axes=(3, 1))
    assert plane.positions(torch.tensor([[1.0, 2.0, 3.0, 4.0]])).tolist() == [[4.0, 2.0]]
    assert plane.outlines == ()


@pytest.mark.parametrize("env", PLANES.values(), ids=PLANES)
def test_the_grid_fills_the_picture_from_its_upper_left_corner(env):
    plane = env.plane(points=20)
    assert plane.states.shape[2:] == env.observation_spec["state"].shape[1:]
    assert max(plane.states.shape[:2]) == 20
    left, right, bottom, top = plane.extent
    at = plane.positions(plane.states)
    side = torch.tensor([right - left, bottom - top])
    assert ((at[0, 0] - torch.tensor([left, top])) / side < 0.05).all()
    assert ((torch.tensor([right, bottom]) - at[-1, -1]) / side < 0.05).all()


@pytest.mark.parametrize("env", PLANES.values(), ids=PLANES)
def test_states_move_without_noise_one_by_one_as_together(env):
    states = env.plane(points=6).states
    action = env.action_spec.rand()[0]
    moved = env.advance_noiseless(states, action.expand(*states.shape[:2], -1))
    assert moved.shape == states.shape
    assert torch.equal(moved[2, 3], env.advance_noiseless(states[2, 3], action))


def test_navigations_outlines_are_its_wall_and_its_goal():
    env = ENVS["navigation"]
    wall, goal = env.plane().outlines
    assert isinstance(wall, Rectangle)
    assert isinstance(goal, Circle)
    plane = env.plane(points=180)
    at = plane.positions(plane.states)
    inside = ((at > torch.tensor(wall.low)) & (at < torch.tensor(wall.high))).all(-1, keepdim=True)
    assert torch.equal(inside, env._violates(plane.states))
    near = (at - torch.tensor(goal.centre)).norm(dim=-1, keepdim=True) <= goal.radius
    assert torch.equal(near, env._succeeds(plane.states))


def test_navigation_without_noise_is_its_step_without_noise():
    env = ls3_envs.make("navigation", num_envs=3, seed=0).base_env
    env.reset()
    env._state = torch.tensor([[30.0, 75.0], [1.0, 149.0], [74.0, 75.0]])
    env._noise.zero_()
    action = torch.tensor([[3.0, -1.0], [-3.0, 3.0], [3.0, 0.0]])
    there = env.advance_noiseless(env._state, action)
    assert there.tolist() == [[33.0, 74.0], [0.0, 150.0], [77.0, 75.0]]
    assert torch.equal(env.step(env.fake_tensordict().set("action", action))["next", "state"], there)


@pytest.mark.parametrize("name", [name for name in ENVS if name not in PLANES])
def test_domains_without_a_plane_say_what_a_plane_takes(name):
    with pytest.raises(NotImplementedError, match=rf"{type(ENVS[name]).__name__} .*defines advance_noiseless"):
        ENVS[name].advance_noiseless(torch.zeros(1, 2), torch.zeros(1, 2))


@pytest.mark.parametrize("name", ENVS)
def test_pictures_for_people_are_in_colour(name):
    env = ls3_envs.make(name, num_envs=2, frames=1, seed=0)
    observed, shown = env.reset()["pixels"], env.base_env.render_rgb()
    assert shown.dtype == torch.uint8
    assert shown.shape == (2, 3, 64, 64)
    assert not torch.equal(shown[:, 0], shown[:, 1])
    assert not torch.equal(shown[:, 1], shown[:, 2])
    assert torch.equal(shown, observed) is (name != "cable_routing")
