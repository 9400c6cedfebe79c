"""VisualConstraintEnv on a domain small enough to follow by hand: a point on a line."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import step_mdp
from torchrl.envs.utils import check_env_specs

from ls3_envs import VisualConstraintEnv


class LineEnv(VisualConstraintEnv):
    """A point moves along a line; it starts near 0, must stay below 5, and wants to be at -5 or below."""

    def __init__(self, num_envs: int = 1, *, start: float = 0.0, horizon: int = 8, seed: int | None = 0) -> None:
        self.start = start
        super().__init__(
            num_envs=num_envs,
            state_dim=1,
            action_low=(-2.0,),
            action_high=(2.0,),
            horizon=horizon,
            image_size=4,
            seed=seed,
        )

    def _initial_state(self, index: int, generator: np.random.Generator) -> Tensor:
        return torch.tensor([self.start + 0.01 * generator.normal()], dtype=torch.float32)

    def _advance(self, state: Tensor, action: Tensor) -> Tensor:
        return state + action

    def _render(self, state: Tensor) -> Tensor:
        grey = (128 + 10 * state).clamp(0, 255).round().to(torch.uint8)
        return grey.view(-1, 1, 1, 1).expand(-1, 3, self.image_size, self.image_size).contiguous()

    def _violates(self, state: Tensor) -> Tensor:
        return state > 5.0

    def _succeeds(self, state: Tensor) -> Tensor:
        return state <= -5.0


def play(env: VisualConstraintEnv, actions: list[list[float]]) -> TensorDict:
    """One episode of given actions, a list of rows (one number a world), as a tensordict [N, T]."""
    td, steps = env.reset(), []
    for row in actions:
        td = env.step(td.set("action", torch.tensor(row).unsqueeze(-1)))
        steps.append(td)
        td = step_mdp(td)
    return torch.stack(steps, 1)


@pytest.mark.parametrize("num_envs", [1, 3])
def test_specs_describe_what_the_environment_returns(num_envs: int):
    check_env_specs(LineEnv(num_envs))


def test_key_set_shapes_and_dtypes():
    step = play(LineEnv(3), [[0.0, 0.0, 0.0]])["next"]
    expected = {
        "pixels": ((3, 1, 3, 4, 4), torch.uint8),
        "state": ((3, 1, 1), torch.float32),
        "reward": ((3, 1, 1), torch.float32),
        **dict.fromkeys(("constraint", "success", "done", "terminated", "truncated"), ((3, 1, 1), torch.bool)),
    }
    assert {key: (tuple(value.shape), value.dtype) for key, value in step.items()} == expected


def test_reward_is_zero_in_the_goal_set_and_minus_one_outside():
    episode = play(LineEnv(), [[-2.0], [-2.0], [-2.0], [2.0]])
    assert episode["next", "success"].flatten().tolist() == [False, False, True, False]
    assert episode["next", "reward"].flatten().tolist() == [-1.0, -1.0, 0.0, -1.0]


def test_episodes_end_by_truncation_exactly_at_the_horizon():
    # One world is in the goal, one violates: neither ends an episode early.
    episode = play(LineEnv(2, horizon=5), [[-2.0, 2.0]] * 5)
    assert episode["next", "success"][0].any()
    assert episode["next", "constraint"][1].any()
    assert episode["next", "truncated"][..., 0].tolist() == [[False] * 4 + [True]] * 2
    assert episode["next", "done"][..., 0].tolist() == [[False] * 4 + [True]] * 2
    assert not episode["next", "terminated"].any()


def test_a_violation_freezes_the_world_for_the_rest_of_the_episode():
    env = LineEnv(2)
    episode = play(env, [[2.0, 1.0]] * 3 + [[-2.0, -2.0]] * 5)
    positions = episode["next", "state"][..., 0]
    # World 0 passes 5 at its third step; the way back is closed to it and open to world 1.
    assert episode["next", "constraint"][0, :, 0].tolist() == [False, False] + [True] * 6
    assert (positions[0, 2:] == positions[0, 2]).all()
    assert (episode["next", "pixels"][0, 2:] == episode["next", "pixels"][0, 2]).all()
    assert (positions[1, 1:] != positions[1, :-1]).all()
    assert not episode["next", "constraint"][1].any()
    # A reset sets it free.
    td = env.step(env.reset().set("action", torch.ones(2, 1)))
    torch.testing.assert_close(td["next", "state"] - td["state"], torch.ones(2, 1))


def test_a_world_that_starts_in_violation_is_frozen_from_the_start():
    episode = play(LineEnv(start=6.0), [[-2.0], [-2.0]])
    assert episode["constraint"].all()
    assert (episode["next", "state"] == episode["state"]).all()


def test_a_partial_reset_touches_only_the_worlds_it_names():
    env = LineEnv(3, horizon=4)
    td = env.reset()
    for _ in range(3):
        td = step_mdp(env.step(td.set("action", torch.tensor([[2.0], [2.0], [-1.0]]))))
    before = td["state"].clone()
    mask = torch.tensor([[True], [False], [False]])
    after = env.reset(td.set("_reset", mask))
    assert abs(after["state"][0].item()) < 0.1
    assert torch.equal(after["state"][1:], before[1:])
    assert after["constraint"].flatten().tolist() == [False, True, False]
    step = env.step(after.set("action", torch.full((3, 1), -1.0)))
    moved = (step["next", "state"] - step["state"]).flatten()
    # World 0 moves again, world 1 stays frozen, world 2 goes on; only the worlds on their fourth step end.
    torch.testing.assert_close(moved, torch.tensor([-1.0, 0.0, -1.0]))
    assert step["next", "truncated"].flatten().tolist() == [False, True, True]


def test_returned_states_are_not_changed_by_later_steps():
    env = LineEnv()
    td = env.reset()
    first = td["state"].clone()
    env.step(td.clone().set("action", torch.full((1, 1), 2.0)))
    env.reset()
    assert torch.equal(td["state"], first)


@pytest.mark.parametrize("value", [2.01, -2.01, float("nan"), float("inf")])
def test_actions_outside_the_box_or_not_finite_are_refused(value: float):
    env = LineEnv(2)
    td = env.reset().set("action", torch.tensor([[0.0], [value]]))
    with pytest.raises(ValueError, match=r"allowed are \[-2\.0\] to \[2\.0\]"):
        env.step(td)


@pytest.mark.parametrize("value", [2.0, -2.0, 2.0 + 5e-5])
def test_actions_on_the_edge_of_the_box_are_welcome(value: float):
    episode = play(LineEnv(), [[value]])
    moved = episode["next", "state"] - episode["state"]
    torch.testing.assert_close(moved.flatten(), torch.tensor([value]))


def test_each_world_has_its_own_random_stream():
    starts = LineEnv(4).reset()["state"].flatten().tolist()
    assert len(set(starts)) == 4
    assert LineEnv(2).reset()["state"].flatten().tolist() == starts[:2]


def test_set_seed_starts_a_life_anew():
    env = LineEnv(2, seed=3)
    first, second = env.reset()["state"], env.reset()["state"]
    assert not torch.equal(first, second)  # the stream goes on from episode to episode
    env.set_seed(3)
    assert torch.equal(env.reset()["state"], first)
    assert torch.equal(env.reset()["state"], second)


def test_the_episodes_that_are_going_on_can_begin_again_elsewhere():
    env, other = LineEnv(3, seed=1), LineEnv(3, seed=2)
    env.reset()
    env.rollout(4)
    first = env.reset()["state"]
    part = env.reset(TensorDict({"_reset": torch.tensor([[True], [False], [False]])}, [3]))["state"]
    other.set_random_state(env.random_state())
    again = other.reset()["state"]
    assert torch.equal(again[0], part[0])  # each where its own last episode began
    assert torch.equal(again[1:], first[1:])
    assert torch.equal(env.reset()["state"], other.reset()["state"])
    env.set_seeds([5, None, 6])
    other.set_random_state(env.random_state())
    assert torch.equal(env.reset()["state"][[0, 2]], other.reset()["state"][[0, 2]])
    with pytest.raises(ValueError, match="one stream for each of 3 environments, got 2"):
        other.set_random_state(env.random_state()[:2])


def test_without_a_seed_torchs_generator_decides():
    torch.manual_seed(5)
    first = LineEnv(seed=None).reset()["state"]
    other = LineEnv(seed=None).reset()["state"]
    torch.manual_seed(5)
    assert torch.equal(LineEnv(seed=None).reset()["state"], first)
    assert not torch.equal(first, other)


def test_sizes_below_one_are_refused():
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        LineEnv(0)
    with pytest.raises(ValueError, match="horizon must be at least 1 step, got 0"):
        LineEnv(horizon=0)


def test_any_number_of_states_can_be_pictured_and_a_line_has_no_plane():
    env = LineEnv(2)
    images = env.render_states(torch.tensor([[0.0], [1.0], [-1.0]]))
    assert images.shape == (3, 3, 4, 4)
    assert images[:, 0, 0, 0].tolist() == [128, 138, 118]
    assert env.plane() is None
    with pytest.raises(NotImplementedError, match=r"LineEnv does not say .*has a plane\(\) defines advance_noiseless"):
        env.advance_noiseless(torch.zeros(1, 1), torch.zeros(1, 1))
