"""Episodes as the recipes use them."""

import pytest
import torch
from tensordict import TensorDict

from ls3_recipes.rollout import collect_demonstrations, make_env, run_episodes, whole_episodes
from ls3_recipes.run_settings import TaskSettings
from ls3_torchrl.data import Tag


def test_episodes_whose_physics_blew_up_are_left_out_and_it_is_said(capsys):
    broken = torch.zeros(3, 4, 1, dtype=torch.bool)
    episodes = TensorDict({"next": {"physics_error": broken}, "number": torch.arange(3)[:, None].expand(3, 4)}, [3, 4])
    assert whole_episodes(episodes) is episodes
    broken[1, 2] = True
    assert whole_episodes(episodes)["number"][:, 0].tolist() == [0, 2]
    assert "1 episodes were left out" in capsys.readouterr().out
    broken[:] = True
    with pytest.raises(RuntimeError, match=r"in every episode\. Lower"):
        whole_episodes(episodes)


def test_the_tasks_horizon_and_number_of_episodes_are_the_settings():
    task = TaskSettings(name="navigation", horizon=7, offline_episodes=2)
    assert make_env(task, 3, 0, torch.device("cpu")).base_env.horizon == 7
    assert make_env(TaskSettings(name="navigation"), 3, 0, torch.device("cpu")).base_env.horizon == 100
    data = collect_demonstrations(task, seed=0)
    assert {tag: tuple(episodes.shape) for tag, episodes in data.items()} == {
        Tag.SUCCESS: (2, 100),
        Tag.CONSTRAINT: (2, 100),
    }


def test_a_policy_acts_for_whole_episodes_and_its_output_is_its_own():
    env = make_env(TaskSettings(name="navigation", horizon=5), 2, 0, torch.device("cpu"))
    env.reset()

    class Still(torch.nn.Module):
        def forward(self, td):
            return td.set("action", torch.zeros(2, 2))

    episodes = run_episodes(env, Still(), what="Test")
    assert episodes.shape == (2, 5)
    assert not episodes["action"].any()
