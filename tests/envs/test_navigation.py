"""Navigation: dynamics, goal, wall and picture of section 1.3.1."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import step_mdp
from torchrl.envs.utils import check_env_specs

from ls3_envs import NavigationEnv
from ls3_envs.navigation import in_wall


def some_actions(num_envs: int, steps: int) -> torch.Tensor:
    """Actions [N, T, 2] in the box; the first rows do not depend on how many there are."""
    generator = torch.Generator().manual_seed(7)
    return 6 * torch.rand(8, steps, 2, generator=generator)[:num_envs] - 3


def play(env: NavigationEnv, actions: torch.Tensor) -> TensorDict:
    td, steps = env.reset(), []
    for t in range(actions.shape[1]):
        td = env.step(td.set("action", actions[:, t]))
        steps.append(td)
        td = step_mdp(td)
    return torch.stack(steps, 1)


def place(env: NavigationEnv, *positions: tuple[float, float]) -> TensorDict:
    """A reset after which the worlds stand at given positions."""
    td = env.reset()
    env._state = torch.tensor(positions)
    env._frozen = in_wall(env._state)
    return td


def picture(*position: float) -> torch.Tensor:
    return NavigationEnv(seed=0).render_states(torch.tensor([position]))[0].float()


# Specs, seeds and episodes


@pytest.mark.parametrize("options", [{"num_envs": 1}, {"num_envs": 3, "start": "random"}])
def test_specs_describe_what_the_environment_returns(options: dict):
    check_env_specs(NavigationEnv(horizon=5, **options))


def test_papers_sizes():
    env = NavigationEnv(num_envs=2)
    assert env.horizon == 100
    assert env.action_spec.shape == (2, 2)
    assert env.action_spec.space.low.unique().tolist() == [-3.0]
    assert env.action_spec.space.high.unique().tolist() == [3.0]
    pixels = env.reset()["pixels"]
    assert (pixels.shape, pixels.dtype) == ((2, 3, 64, 64), torch.uint8)


def test_worlds_live_the_same_life_whatever_their_number():
    lives = {n: play(NavigationEnv(n, seed=3), some_actions(n, 12)) for n in (1, 3, 8)}
    for n in (1, 3):
        shared = lives[8][:n]
        for key in (("next", "state"), ("next", "pixels"), ("next", "reward"), "state"):
            assert torch.equal(lives[n][key], shared[key])
    states = lives[8]["state"][:, 0]
    assert len({tuple(row) for row in states.tolist()}) == 8


def test_a_seed_decides_a_life_over_several_episodes():
    def two_episodes(seed: int) -> torch.Tensor:
        env = NavigationEnv(2, seed=seed, horizon=6)
        actions = some_actions(2, 6)
        return torch.cat([play(env, actions)["next", "state"] for _ in range(2)], 1)

    first = two_episodes(3)
    assert torch.equal(two_episodes(3), first)
    assert not torch.equal(two_episodes(4), first)
    assert not torch.equal(first[:, :6], first[:, 6:])


def test_episodes_end_by_truncation_after_100_steps():
    env = NavigationEnv(2, seed=0)
    ends = play(env, torch.zeros(2, 100, 2))["next"]
    assert ends["truncated"][..., 0].tolist() == [[False] * 99 + [True]] * 2
    assert torch.equal(ends["done"], ends["truncated"])
    assert not ends["terminated"].any()


# Dynamics


def test_a_step_adds_the_action_and_noise_of_an_eighth():
    env = NavigationEnv(50, seed=0, horizon=40)
    actions = 0.1 * some_actions(8, 40).repeat(7, 1, 1)[:50]  # small enough to stay away from the window's edges
    episode = play(env, actions)
    noise = episode["next", "state"] - episode["state"] - actions
    assert noise.mean(dim=(0, 1)).abs().max() < 0.01
    # 2,000 draws an axis: the standard deviation is known to about 1.6 %.
    torch.testing.assert_close(noise.std(dim=(0, 1)), torch.full((2,), 0.125), rtol=0.06, atol=0)


def test_starts_lie_about_30_75_with_unit_spread():
    states = NavigationEnv(1000, seed=0).reset()["state"]
    torch.testing.assert_close(states.mean(0), torch.tensor([30.0, 75.0]), atol=0.15, rtol=0)
    torch.testing.assert_close(states.std(0), torch.ones(2), atol=0.1, rtol=0)


def test_random_starts_cover_the_window_but_not_the_wall():
    env = NavigationEnv(1000, start="random", seed=0)
    td = env.reset()
    assert not td["constraint"].any()
    # The wall would hold 3.7 % of uniform starts; the frame is reached on every side.
    low, high = td["state"].amin(0), td["state"].amax(0)
    assert (low < torch.tensor([3.0, 3.0])).all()
    assert (high > torch.tensor([177.0, 147.0])).all()
    assert (low >= 0).all()
    assert (high <= torch.tensor([180.0, 150.0])).all()


def test_the_window_stops_the_disc():
    env = NavigationEnv(2, seed=0)
    td = place(env, (1.0, 149.0), (179.0, 1.0))
    for _ in range(3):
        td = step_mdp(env.step(td.set("action", torch.tensor([[-3.0, 3.0], [3.0, -3.0]]))))
    assert td["state"].tolist() == [[0.0, 150.0], [180.0, 0.0]]


def test_entering_the_wall_freezes_the_disc():
    env = NavigationEnv(2, seed=0)
    td = place(env, (74.0, 75.0), (74.0, 110.0))
    td = step_mdp(env.step(td.set("action", torch.full((2, 2), 3.0))))
    assert td["constraint"].flatten().tolist() == [True, False]
    stuck = td["state"][0].clone()
    for _ in range(5):
        td = step_mdp(env.step(td.set("action", torch.full((2, 2), -3.0))))
    assert torch.equal(td["state"][0], stuck)
    assert td["constraint"].flatten().tolist() == [True, False]
    assert td["state"][1, 0] < 65


@pytest.mark.parametrize(
    ("position", "inside"),
    [
        ((75.0, 55.0), True),
        ((100.0, 95.0), True),
        ((87.5, 75.0), True),
        ((74.9, 75.0), False),
        ((100.1, 75.0), False),
        ((87.5, 54.9), False),
        ((87.5, 95.1), False),
    ],
)
def test_the_wall_is_the_rectangle_of_the_paper(position: tuple[float, float], inside: bool):
    assert in_wall(torch.tensor(position)).tolist() == [inside]


def test_the_goal_is_the_ball_of_radius_3_about_150_75():
    env = NavigationEnv(5, seed=0)
    positions = [(150.0, 75.0), (153.0, 75.0), (150.0, 72.0), (152.2, 77.2), (153.01, 75.0)]
    inside = env._succeeds(torch.tensor(positions)).flatten()
    # The fourth lies in the square about the ball but outside the ball: 2.2 * sqrt(2) > 3.
    assert inside.tolist() == [True, True, True, False, False]
    td = place(env, *positions)
    env._noise.zero_()
    step = env.step(td.set("action", torch.zeros(5, 2)))
    assert step["next", "success"].flatten().tolist() == inside.tolist()
    assert step["next", "reward"].flatten().tolist() == [0.0, 0.0, 0.0, -1.0, -1.0]


def test_the_best_return_is_about_minus_40():
    # Full speed along the axis over the wall's lower edge: both axes move at once, so the detour is free.
    env = NavigationEnv(4, seed=0)
    td, total = env.reset(), torch.zeros(4, 1)
    for _ in range(100):
        x, y = td["state"][:, :1], td["state"][:, 1:]
        beside = (x > 60) & (x < 101)
        height = torch.where((x <= 60) | beside, 103.0, 75.0)
        action = torch.cat([150.0 - x, height - y], -1).clamp(-3, 3)
        step = env.step(td.set("action", action))
        total += step["next", "reward"]
        td = step_mdp(step)
    assert not td["constraint"].any()
    assert ((total > -43) & (total < -37)).all()


def test_bad_actions_and_options_are_refused():
    env = NavigationEnv(2, seed=0)
    for bad in (3.1, -3.1, float("nan")):
        action = torch.zeros(2, 2)
        action[1, 0] = bad
        with pytest.raises(ValueError, match=r"allowed are \[-3\.0, -3\.0\] to \[3\.0, 3\.0\]"):
            env.step(env.reset().set("action", action))
    with pytest.raises(ValueError, match="start must be 'fixed' or 'random', got 'anywhere'"):
        NavigationEnv(start="anywhere")


def test_a_partial_reset_gives_one_world_a_new_start_and_new_noise():
    env = NavigationEnv(3, seed=0, horizon=20)
    td = env.reset()
    for _ in range(5):
        td = step_mdp(env.step(td.set("action", torch.ones(3, 2))))
    before, noise = td["state"].clone(), env._noise.clone()
    after = env.reset(td.set("_reset", torch.tensor([[False], [True], [False]])))
    assert torch.equal(after["state"][[0, 2]], before[[0, 2]])
    assert (after["state"][1] - torch.tensor([30.0, 75.0])).norm() < 5
    assert torch.equal(env._noise[[0, 2]], noise[[0, 2]])
    assert not torch.equal(env._noise[1], noise[1])


# The picture


def test_background_is_black_and_the_wall_blue():
    image = picture(30.0, 75.0)
    # A pixel is 2.8125 by 2.34375 units: the wall covers columns 26.7 to 35.6 and rows 23.5 to 40.5.
    wall = image[:, 24:40, 27:35]
    assert (wall[2] == 255).all()
    assert (wall[:2] == 0).all()
    assert (image[:, :, 38:] == 0).all()
    assert (image[:, :15] == 0).all()
    assert (image[1] == 0).all()
    # Edge pixels are as blue as the wall covers them: in all, the wall's 25 by 40 units.
    covered = image[2].sum().item() / 255 * 2.8125 * 2.34375
    assert covered == pytest.approx(25 * 40, rel=0.005)


@pytest.mark.parametrize("position", [(30.0, 75.0), (130.3, 40.1), (141.7, 101.9)])
def test_disc_is_red_and_covers_the_area_of_radius_10(position: tuple[float, float]):
    red = picture(*position)[0] / 255
    pixels = red.sum().item()
    assert pixels == pytest.approx(math.pi * 10**2 / (2.8125 * 2.34375), rel=0.03)
    # Its centre of mass is the position, x along the columns and y down the rows.
    centre = torch.arange(64) + 0.5
    assert (red.sum(0) * centre).sum().item() / pixels * 2.8125 == pytest.approx(position[0], abs=0.2)
    assert (red.sum(1) * centre).sum().item() / pixels * 2.34375 == pytest.approx(position[1], abs=0.2)


def test_disc_has_a_soft_edge():
    red = picture(30.0, 75.0)[0]
    assert (red == 255).any()
    assert ((red > 0) & (red < 255)).sum() >= 10


def test_disc_is_drawn_over_the_wall():
    # A violating state must be visible: the disc's middle is pure red even inside the wall.
    image = picture(87.5, 75.0)
    assert image[:, 31:33, 30:32].flatten(1).unique(dim=1).flatten().tolist() == [255.0, 0.0, 0.0]


def test_a_small_move_changes_the_picture():
    # Without antialiasing, a move of a fifth of a pixel would be lost.
    assert not torch.equal(picture(50.0, 75.0), picture(50.5, 75.0))


def test_pictures_of_several_worlds_are_those_of_each():
    env = NavigationEnv(seed=0)
    states = torch.tensor([[30.0, 75.0], [87.5, 60.0], [0.0, 150.0]])
    together = env.render_states(states)
    assert together.dtype == torch.uint8
    for i in range(3):
        assert torch.equal(together[i], env.render_states(states[i : i + 1])[0])


def test_the_plane_covers_the_window_row_by_row():
    plane, extent = NavigationEnv(seed=0).plane(points=6)[:2]
    assert plane.shape == (5, 6, 2)
    assert extent == (0.0, 180.0, 150.0, 0.0)  # the picture's top is y = 0
    # Cells of 30 by 30 units, x along the columns and y down the rows.
    assert plane[0, 0].tolist() == [15.0, 15.0]
    assert plane[0, 5].tolist() == [165.0, 15.0]
    assert plane[4, 0].tolist() == [15.0, 135.0]
