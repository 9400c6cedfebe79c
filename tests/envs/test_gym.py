"""The domains behind Gymnasium's interfaces."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import ls3_envs

GYM_IDS = {
    "ls3/Navigation-v0": "navigation",
    "ls3/Reacher-v0": "reacher",
    "ls3/SequentialPushing-v0": "pushing",
    "ls3/CableRouting-v0": "cable_routing",
}


def test_every_row_has_its_id():
    assert {row.gym_id: name for name, row in ls3_envs.DOMAINS.items()} == GYM_IDS
    for name, domain in GYM_IDS.items():
        assert gymnasium.spec(name).kwargs == {"domain": domain}


@pytest.mark.parametrize("name", GYM_IDS)
def test_gymnasiums_own_checker_finds_nothing(name):
    check_env(gymnasium.make(name, render_mode="rgb_array", horizon=8).unwrapped)


@pytest.mark.parametrize("name", GYM_IDS)
def test_an_episode(name):
    env = gymnasium.make(name, render_mode="rgb_array", horizon=3)
    first, info = env.reset(seed=1)
    assert first.dtype == np.uint8
    assert first.shape == (64, 64, 9 if "Reacher" in name else 3)
    assert {key: bool(value) for key, value in info.items() if key != "physics_error"} == {
        "constraint": False,
        "success": False,
        "cost": False,
    }
    for t in range(3):
        env.action_space.seed(t)
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert isinstance(reward, float)
        assert (terminated, truncated) == (False, t == 2)
    assert env.render().shape == (64, 64, 3)
    again, _ = env.reset(seed=1)
    np.testing.assert_array_equal(again, first)


def test_the_images_are_the_environments_own():
    env = gymnasium.make("ls3/Navigation-v0")
    observation, _ = env.reset(seed=3)
    own = ls3_envs.NavigationEnv(num_envs=1, seed=3).reset()["pixels"][0]
    np.testing.assert_array_equal(observation, own.permute(1, 2, 0).numpy())


def test_cable_routing_shows_colours_to_people_and_masks_to_agents():
    env = gymnasium.make("ls3/CableRouting-v0", render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    assert set(np.unique(observation)) == {0, 255}
    assert len(np.unique(env.render())) > 3


def test_a_vector_of_worlds_starts_ended_ones_anew():
    envs = gymnasium.make_vec("ls3/Navigation-v0", num_envs=2, vectorization_mode="vector_entry_point", horizon=3)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    first, info = envs.reset(seed=0)
    assert first.shape == (2, 64, 64, 3)
    assert info["constraint"].tolist() == [False, False]
    still = np.zeros((2, 2), np.float32)
    for t in range(3):
        images, rewards, terminated, truncated, info = envs.step(still)
        assert rewards.tolist() == [-1.0, -1.0]
        assert not terminated.any()
        assert truncated.tolist() == [t == 2] * 2
    images, rewards, _, truncated, _ = envs.step(still + 1)
    assert rewards.tolist() == [0.0, 0.0]
    assert not truncated.any()
    # Each world lives the life that it lives alone.
    alone = ls3_envs.NavigationEnv(num_envs=1, horizon=3, seed=0)
    alone.reset()
    np.testing.assert_array_equal(images[0], alone.reset()["pixels"][0].permute(1, 2, 0).numpy())
    assert not np.array_equal(images, first)


def test_one_world_can_start_anew_while_others_go_on():
    envs = ls3_envs.GymVectorEnv("navigation", 2, horizon=4)
    envs.reset(seed=0)
    envs._ended = np.array([True, False])
    before = envs._batch.seen["state"].clone()
    _, rewards, _, _, _ = envs.step(np.full((2, 2), 1.0, np.float32))
    assert rewards.tolist() == [0.0, -1.0]
    after = envs._batch.seen["state"]
    assert (after[0] - torch.tensor([30.0, 75.0])).norm() < 6
    assert (after[1] - before[1]).min() > 2


def test_another_render_mode_is_refused():
    with pytest.raises(ValueError, match="'rgb_array', got 'human'"):
        ls3_envs.GymEnv("navigation", render_mode="human")


def test_plus_and_minus_one_are_the_edges_of_the_domains_box():
    env = gymnasium.make("ls3/Navigation-v0")
    env.reset(seed=0)
    before = env.unwrapped._batch.seen["state"].clone()
    env.step(np.array([1.0, -0.5], np.float32))
    moved = env.unwrapped._batch.seen["state"] - before
    torch.testing.assert_close(moved, torch.tensor([[3.0, -1.5]]), atol=0.6, rtol=0.0)  # noise of 0.125
    with pytest.raises(ValueError, match=r"outside the action space .* allowed are -1 to 1"):
        env.unwrapped.step(np.array([1.5, 0.0], np.float32))
