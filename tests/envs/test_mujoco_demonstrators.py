"""The MuJoCo domains' scripted policies keep the promises that the offline data rest on."""

import pytest
import torch

from ls3_envs import CableRoutingEnv, collect_offline
from ls3_envs.pushing import block_positions
from ls3_envs.reacher import OBSTACLE, OBSTACLE_RADIUS, finger_position


def rates(name: str, kind: str, episodes: int) -> tuple[float, float, torch.Tensor]:
    data = collect_offline(name, kind, episodes=episodes, seed=0)
    assert not data["next", "physics_error"].any()
    success, violation = (data["next", key].any(1).float().mean().item() for key in ("success", "constraint"))
    return success, violation, data["next", "reward"].sum((1, 2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least", "horizon"), [("reacher", 0.85, 100), ("pushing", 0.9, 150), ("cable_routing", 0.9, 50)]
)
def test_demonstrations_succeed_violate_nothing_and_leave_room(name, least, horizon):
    success, violation, returns = rates(name, "success", 20)
    assert success >= least
    assert violation == 0.0
    assert -horizon < returns.mean() < -horizon / 4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reacher", "pushing", "cable_routing"])
def test_violating_data_violate_in_most_trajectories(name):
    assert rates(name, "constraint", 30)[1] >= 0.6


def test_reachers_demonstrations_keep_their_distance_from_the_disc():
    data = collect_offline("reacher", "success", episodes=20, seed=0)
    distance = (finger_position(data["next", "state"]) - torch.tensor(OBSTACLE)).norm(dim=-1)
    margin = distance.amin(1) - OBSTACLE_RADIUS
    assert margin.median() > 0.02
    assert margin.min() > 0.015


def test_cable_demonstrations_keep_three_pixels_from_the_obstacle_and_cover_the_goal_to_the_end():
    data = collect_offline("cable_routing", "success", episodes=8, seed=0)
    obstacle = CableRoutingEnv()._obstacle_mask.float()
    near = torch.nn.functional.max_pool2d(obstacle[None], 7, stride=1, padding=3)[0] > 0
    cable = data["next", "pixels"][..., 0, :, :] > 0
    assert not (cable & near).any()
    assert data["next", "success"][:, -5:].all()


def test_wandering_torques_stay_in_the_box_and_wander():
    data = collect_offline("reacher", "rand", episodes=20, seed=0)
    assert data.batch_size == (20, 20)
    actions = data["action"]
    assert actions.abs().max() <= 1.0
    steps = actions.diff(dim=1)
    inside = (actions[:, 1:].abs() < 1.0) & (actions[:, :-1].abs() < 0.3)
    assert abs(steps[inside].std().item() - 0.2**0.5) < 0.1  # a' ~ N(a, 0.2), clamped


def test_random_cable_data_leave_the_demonstration_at_random():
    data, demonstrations = (collect_offline("cable_routing", kind, episodes=8, seed=0) for kind in ("rand", "success"))
    assert data["action"].abs().max() <= 0.02 + 1e-6
    # Uniform actions are far wider than the demonstrator's noise.
    assert data["action"][:, -8:].std() > 2 * demonstrations["action"][:, -8:].std()


@pytest.mark.slow
def test_pushing_demonstrations_hold_every_order_of_the_blocks_and_push_past_the_line():
    data = collect_offline("pushing", "success", episodes=40, seed=0)
    y = block_positions(data["next", "state"])[..., 1]
    first = (y > 0.075).int().argmax(1)  # [40, 3], the step at which each block is in its goal
    orders = {tuple(order) for order in first.argsort(-1).tolist()}
    assert len(orders) == 6
    assert (y[:, -1] > 0.085).float().mean() > 0.95


@pytest.mark.slow
def test_pushing_violations_start_from_any_number_of_blocks_in_their_goals():
    data = collect_offline("pushing", "constraint", episodes=40, seed=0)
    y = block_positions(data["state"])[..., 1]
    in_goal = (y > 0.075).sum(-1)
    fractions = torch.bincount(in_goal.flatten(), minlength=4) / in_goal.numel()
    assert (fractions > 0.02).all()


@pytest.mark.slow
def test_pushing_violations_hit_the_blocks_from_the_side_too():
    data = collect_offline("pushing", "constraint", episodes=40, seed=0)
    moved = block_positions(data["next", "state"])[..., 0] - block_positions(data["state"])[..., 0]
    # From the front, with bursts as wild, it is one step in 200.
    assert (moved.abs().amax(-1) > 0.01).float().mean() > 0.02
