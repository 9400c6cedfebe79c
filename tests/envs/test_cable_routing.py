"""Cable routing: masks by colour and by segmentation, and what they decide."""

import pytest
import torch

from ls3_envs import CableRoutingEnv
from ls3_envs.cable_routing import GOAL, OBSTACLE, is_blue, is_green, is_red


def with_the_end_at(env: CableRoutingEnv, x: float, y: float) -> torch.Tensor:
    state = torch.zeros(1, env.model.nq + env.model.nv, dtype=torch.float64)
    state[0, 0], state[0, 1] = x, y
    return state


def test_the_observation_is_the_cables_mask_in_three_equal_channels():
    env, coloured = (CableRoutingEnv(num_envs=2, observation=name, seed=0) for name in ("mask", "rgb"))
    mask, picture = (e.reset()["pixels"] for e in (env, coloured))
    assert set(mask.unique().tolist()) == {0, 255}
    assert torch.equal(mask[:, 0], mask[:, 1])
    assert torch.equal(mask[:, 0], mask[:, 2])
    assert 30 < int((mask[0, 0] > 0).sum()) < 200
    # Colour masking and segmentation agree on every pixel.
    assert torch.equal(is_red(picture), mask[:, 0] > 0)
    assert is_green(picture).any()
    assert is_blue(picture).any()
    assert torch.equal(env.render_rgb(), picture)


def test_cable_over_the_goal_is_success_and_over_the_obstacle_a_violation():
    env = CableRoutingEnv(num_envs=1, seed=0)
    for place, success, violation in (
        (GOAL, True, False),
        (OBSTACLE, False, True),
        ((-0.13, -0.02), False, False),
        ((0.19, -0.02), False, False),
    ):
        state = with_the_end_at(env, *place)
        assert bool(env._succeeds(state)) is success, place
        assert bool(env._violates(state)) is violation, place


def test_the_grasped_end_goes_where_it_is_told_and_the_cable_follows():
    env = CableRoutingEnv(num_envs=1, seed=0)
    td = env.reset()
    start = td["state"][0, :2].clone()
    moved = env.step(td.set("action", torch.tensor([[0.01, 0.02]])))["next", "state"][0]
    torch.testing.assert_close(moved[:2] - start, torch.tensor([0.01, 0.02]), atol=4e-3, rtol=0)
    assert moved[2:17].abs().max() > 1e-3


def test_an_unknown_observation_is_refused():
    with pytest.raises(ValueError, match="'mask' or 'rgb', got 'depth'"):
        CableRoutingEnv(observation="depth")


@pytest.mark.parametrize("way", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_the_grasped_end_stays_in_the_picture(way):
    env = CableRoutingEnv(num_envs=1, seed=0)
    td = env.reset()
    state = env._state
    for _ in range(25):
        state = env.physics(state, env._control(state, 0.02 * torch.tensor([way], dtype=torch.float64)))
    x, y = state[0, :2].tolist()
    assert abs(x) < 0.19
    assert -0.21 < y < 0.17
    assert env._segment(env._view(state)).any()
    assert td["pixels"].any()
