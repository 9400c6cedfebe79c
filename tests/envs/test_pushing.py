"""Sequential pushing: what is pushed where, and when it counts."""

import pytest
import torch
from torchrl.envs import step_mdp

from ls3_envs import SequentialPushingEnv
from ls3_envs.pushing import (
    BLOCK_SIDE,
    BLOCKS_X,
    GOAL_Y,
    GRIPPER,
    IN_GOAL_AT_RANDOM,
    PEG_RADIUS,
    TABLE,
    block_positions,
    hand_position,
)


def with_blocks_at(y: list[float], z: float = 0.03) -> torch.Tensor:
    env = SequentialPushingEnv(num_envs=1, seed=0)
    env.reset()
    state = env._state.clone()
    for i, value in enumerate(y):
        state[0, 7 * i + 1], state[0, 7 * i + 2] = value, z
    return state


def test_blocks_stand_in_a_row_with_clear_gaps():
    state = SequentialPushingEnv(num_envs=1, seed=0).reset()["state"]
    places = block_positions(state)[0]
    torch.testing.assert_close(places[:, 0], torch.tensor(BLOCKS_X))
    assert (places[1:, 0] - places[:-1, 0] > 0.08).all()
    assert hand_position(state)[0, 1] < -0.1


@pytest.mark.parametrize(
    ("y", "success", "constraint"),
    [
        ([0.08, 0.08, 0.08], True, False),
        ([0.08, 0.08, 0.07], False, False),
        ([0.08, 0.08, 0.21], False, True),
        ([0.0, 0.0, 0.0], False, False),
    ],
)
def test_all_blocks_past_the_line_are_success_and_one_past_the_edge_is_a_violation(y, success, constraint):
    env = SequentialPushingEnv(num_envs=1, seed=0)
    state = with_blocks_at(y)
    assert bool(env._succeeds(state)) is success
    assert bool(env._violates(state)) is constraint
    assert GOAL_Y == 0.075
    assert TABLE[1] == 0.2


def test_a_block_that_fell_is_a_violation():
    assert bool(SequentialPushingEnv(num_envs=1, seed=0)._violates(with_blocks_at([0.0, 0.0, 0.1], z=-0.1)))


def test_the_hand_goes_where_it_is_told_and_takes_a_block_along():
    env = SequentialPushingEnv(num_envs=1, seed=0)
    td = env.reset()
    start = hand_position(td["state"])[0].clone()
    td = env.step(td.set("action", torch.tensor([[0.02, 0.01]])))
    torch.testing.assert_close(
        hand_position(td["next", "state"])[0] - start, torch.tensor([0.02, 0.01]), atol=4e-3, rtol=0
    )
    for _ in range(10):
        td = env.step(step_mdp(td).set("action", torch.tensor([[-0.002, 0.02]])))
    moved = block_positions(td["next", "state"])[0, :, 1]
    assert moved[1] > 0.05
    assert moved[[0, 2]].abs().max() < 1e-3


@pytest.mark.parametrize("way", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_the_hand_stays_on_the_table_and_its_tip_in_the_picture(way):
    env = SequentialPushingEnv(num_envs=1, seed=0)
    td = env.reset()
    for _ in range(15):
        td = step_mdp(env.step(td.set("action", 0.05 * torch.tensor([way], dtype=torch.float32))))
    x, y = hand_position(td["state"])[0].tolist()
    assert abs(x) < TABLE[0] - 0.02
    assert abs(y) < TABLE[1] - 0.01
    view = env._view(env._state)
    assert (view.geoms == env.model.geom("hand").id).sum() + (view.geoms == env.model.geom("arm").id).sum() >= 8


def test_the_arm_is_a_picture_only():
    arm = SequentialPushingEnv(num_envs=1, seed=0).model.geom("arm")
    assert int(arm.contype[0]) == int(arm.conaffinity[0]) == 0
    env = SequentialPushingEnv(num_envs=1, seed=0)
    assert float(env.model.body("hand").mass[0]) == pytest.approx(0.5)


def test_a_block_is_seen_whole_where_it_leaves_the_table():
    env = SequentialPushingEnv(num_envs=3, seed=0)
    env.reset()
    env._state[1, 0], env._state[2, 14] = -TABLE[0], TABLE[0]
    seen = [
        (env._view(env._state).geoms[row] == env.model.geom(f"block{block}").id).sum().item()
        for row, block in ((0, 0), (1, 0), (2, 2))
    ]
    assert min(seen[1:]) >= seen[0]  # the nearer to the edge the more of a side is seen, too


def test_a_random_start_has_each_block_in_its_place_or_in_its_goal():
    state = SequentialPushingEnv(num_envs=200, start="random", seed=0).reset()["state"]
    y = block_positions(state)[..., 1]
    waiting, there = y == 0.0, (y > GOAL_Y) & (y < TABLE[1] - BLOCK_SIDE / 2)
    assert (waiting | there).all()
    assert abs(there.float().mean() - IN_GOAL_AT_RANDOM) < 0.06
    assert len(there.unique(dim=0)) == 8  # every combination
    aside = block_positions(state)[..., 0] - torch.tensor(BLOCKS_X)
    assert (aside[:, 1] == 0).all()
    out = torch.cat([-aside[:, 0], aside[:, 2]])
    assert out.min() >= -1e-6
    assert 0.13 < out.max() <= 0.14 + 1e-6
    assert abs((out > 1e-6).float().mean() - 0.5) < 0.06
    assert (hand_position(state)[:, 1] <= -0.06).all()


def pushed_askew(hand: str, offset: float) -> tuple[float, float]:
    """How far the middle block goes along y and turns, pushed 10 cm by a hand that is off its middle."""
    env = SequentialPushingEnv(num_envs=1, hand=hand, seed=0)
    td = env.reset()
    env._state[0, 21:23] = torch.tensor([offset, -0.06])
    for _ in range(2):
        td = step_mdp(env.step(td.set("action", torch.tensor([[0.0, 0.05]]))))
    w, z = td["state"][0, 10], td["state"][0, 13]
    return float(block_positions(td["state"])[0, 1, 1]), abs(float(2 * torch.atan2(z, w)))


def test_a_gripper_takes_a_block_straight_on_and_a_peg_turns_it():
    straight, straight_turn = pushed_askew("gripper", 0.025)
    askew, askew_turn = pushed_askew("peg", 0.025)
    assert straight > 0.06
    assert straight_turn < 0.1
    assert askew < straight - 0.005
    assert askew_turn > 0.5


def test_a_peg_in_the_middle_pushes_as_a_gripper_does():
    gripper, peg = (pushed_askew(hand, 0.0)[0] for hand in ("gripper", "peg"))
    assert abs(peg - gripper - (PEG_RADIUS - GRIPPER[1])) < 2e-3


def test_an_unknown_hand_is_answered_with_the_known_ones():
    with pytest.raises(ValueError, match="'gripper' or 'peg', got 'claw'"):
        SequentialPushingEnv(hand="claw")
