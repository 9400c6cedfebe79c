"""Reacher: geometry of section 1.3.2, seen and computed."""

import math

import mujoco
import numpy as np
import pytest
import torch

from ls3_envs import ReacherEnv
from ls3_envs.reacher import GOAL, OBSTACLE, finger_position, reacher_model


def test_the_finger_is_where_mujoco_has_it():
    model = reacher_model()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(5):
        data.qpos[:] = rng.uniform(-2, 2, 2)
        mujoco.mj_kinematics(model, data)
        state = torch.tensor([*data.qpos, 0.0, 0.0])
        np.testing.assert_allclose(finger_position(state), data.geom("finger").xpos[:2], atol=1e-12)


def test_the_suites_own_model_with_its_torques_halved():
    model = reacher_model()
    assert model.opt.timestep == 0.02
    assert model.actuator("shoulder").gear[0] == 0.05
    env = ReacherEnv(num_envs=1, seed=0)
    env.reset()
    start = env._state.clone()
    stepped = env.step(env.reset().set("action", torch.tensor([[1.0, -0.5]])))
    data = mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = start[0, :2], start[0, 2:], (0.5, -0.25)
    mujoco.mj_step(env.model, data)
    np.testing.assert_allclose(stepped["next", "state"][0], [*data.qpos, *data.qvel], rtol=1e-6)


def test_the_start_is_fixed_safe_and_not_in_the_goal():
    first = ReacherEnv(num_envs=3, seed=1).reset()
    expected = torch.tensor([0.53 * math.pi, 0.85 * math.pi, 0.0, 0.0]).expand(3, -1)
    torch.testing.assert_close(first["state"], expected)
    assert not first["constraint"].any()
    assert not first["success"].any()


def test_random_starts_are_safe_and_differ():
    first = ReacherEnv(num_envs=64, start="random", seed=1).reset()
    assert not first["constraint"].any()
    assert first["state"][:, :2].std(0).min() > 0.5
    assert (first["state"][:, 2:] == 0).all()


def test_goal_and_stay_out_disc_are_drawn_where_they_count():
    pixels = ReacherEnv(num_envs=1, seed=0).reset()["pixels"][0].float()
    green = (pixels[1] > pixels[0] + 60) & (pixels[1] > pixels[2] + 60)
    red = (pixels[0] > pixels[1] + 60) & (pixels[0] > pixels[2] + 100)
    for mask, (x, y) in ((green, GOAL), (red, OBSTACLE)):
        row, column = mask.nonzero().float().mean(0)
        # 64 pixels span 2 * .75 * tan(22.5°) = .621 m about the middle.
        assert abs((column - 31.5) * 0.621 / 64 - x) < 0.01
        assert abs((31.5 - row) * 0.621 / 64 - y) < 0.01


def test_an_unknown_start_is_refused():
    with pytest.raises(ValueError, match="'fixed' or 'random', got 'anywhere'"):
        ReacherEnv(start="anywhere")
