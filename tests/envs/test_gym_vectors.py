"""GymVectorEnv beside Gymnasium's own vectors: the same seeds, masks, infos and ends, errors in its terms."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torchrl.envs import GymEnv as TorchRLGymEnv
from torchrl.envs.utils import check_env_specs

import ls3_envs

IDS = {row.gym_id: name for name, row in ls3_envs.DOMAINS.items()}
NAVIGATION = "ls3/Navigation-v0"


def vector(gym_id: str, mode: str, num_envs: int, autoreset: AutoresetMode = AutoresetMode.NEXT_STEP, **options):
    """One of the three vectors of a domain."""
    own = {"autoreset_mode": autoreset}
    given = own | options if mode == "vector_entry_point" else {"vector_kwargs": own} | options
    return gymnasium.make_vec(gym_id, num_envs=num_envs, vectorization_mode=mode, **given)


def assert_same(found, expected, where=""):
    """Nested dicts, tuples and arrays, object arrays included, agree in dtype and value."""
    if isinstance(expected, dict):
        assert set(found) == set(expected), where
        for key in expected:
            assert_same(found[key], expected[key], f"{where}/{key}")
    elif isinstance(expected, tuple):
        for i, (one, other) in enumerate(zip(found, expected, strict=True)):
            assert_same(one, other, f"{where}/{i}")
    elif isinstance(expected, np.ndarray) and expected.dtype == object:
        assert found.dtype == object
        for one, other in zip(found, expected, strict=True):
            assert (one is None) == (other is None), where
            if other is not None:
                np.testing.assert_array_equal(one, other, where)
    else:
        assert np.asarray(found).dtype == np.asarray(expected).dtype, where
        np.testing.assert_array_equal(found, expected, where)


@pytest.mark.parametrize("autoreset", AutoresetMode)
@pytest.mark.parametrize("gym_id", IDS)
def test_the_same_seeds_lead_to_the_same_lives_as_in_gymnasiums_own_vector(gym_id, autoreset):
    one, other = (vector(gym_id, mode, 3, autoreset, horizon=4) for mode in ("vector_entry_point", "sync"))
    assert one.metadata["autoreset_mode"] == other.metadata["autoreset_mode"] == autoreset
    assert_same(one.reset(seed=7), other.reset(seed=7))
    random = np.random.default_rng(0)
    for t in range(10):
        if t == 2:
            # A world that starts anew in the middle ends later than the others.
            mask = np.array([False, True, False])
            assert_same(*(e.reset(seed=[1, 2, None], options={"reset_mask": mask.copy()}) for e in (one, other)))
        actions = random.uniform(-1, 1, (3, 2)).astype(np.float32)
        steps = one.step(actions), other.step(actions)
        assert_same(*steps)
        ended = steps[1][3]
        if autoreset == AutoresetMode.DISABLED and ended.any():
            with pytest.raises(ResetNeeded, match=r"have ended, and autoreset is disabled\. Call reset\("):
                one.step(actions)
            assert_same(*(e.reset(options={"reset_mask": ended.copy()}) for e in (one, other)))


def test_workers_live_the_same_lives():
    modes = [vector(NAVIGATION, mode, 2, horizon=3) for mode in ("vector_entry_point", "sync", "async")]
    try:
        first, *others = (
            [e.reset(seed=[3, 4]), *(e.step(np.full((2, 2), 0.4, np.float32)) for _ in range(5))] for e in modes
        )
        for other in others:
            for one, expected in zip(first, other, strict=True):
                assert_same(one, expected)
    finally:
        for e in modes:
            e.close()


def test_a_world_of_a_vector_lives_the_life_that_the_domain_lives_alone():
    envs = ls3_envs.GymVectorEnv("navigation", 2)
    images, _ = envs.reset(seed=[8, 3])
    for i, seed in enumerate((8, 3)):
        alone = ls3_envs.NavigationEnv(1, seed=seed).reset()["pixels"][0]
        np.testing.assert_array_equal(images[i], alone.permute(1, 2, 0).numpy())


def test_a_limit_on_steps_is_gymnasiums_and_changes_nothing_else():
    one, other = (vector(NAVIGATION, mode, 2, max_episode_steps=3) for mode in ("vector_entry_point", "sync"))
    assert_same(one.reset(seed=0), other.reset(seed=0))
    for _ in range(9):
        actions = np.full((2, 2), 0.3, np.float32)
        assert_same(one.step(actions), other.step(actions))


SEEDS = st.one_of(
    st.none(),
    st.integers(-2, 2**40),
    st.lists(st.one_of(st.none(), st.integers(-1, 9)), min_size=1, max_size=4),
    st.sampled_from([np.int64(3), np.array([1, 2, 3]), (4, 5, 6), True, 2.0, "3", [1, 2, 2.5], [1, [2], 3]]),
)
MASKS = st.one_of(
    st.just("absent"),
    st.lists(st.booleans(), min_size=1, max_size=4).map(np.array),
    st.sampled_from([[True, False, True], np.array([1, 0, 1]), np.ones((3, 1), bool), None]),
)


@settings(max_examples=150)
@given(seed=SEEDS, mask=MASKS, unknown=st.booleans())
@example(seed=np.int64(3), mask="absent", unknown=False)
@example(seed=[None, 3, None], mask=np.array([False, True, False]), unknown=False)
@example(seed=[1, 2, -1], mask=np.array([True, True, False]), unknown=False)
def test_reset_takes_what_gymnasium_takes_or_refuses_and_leaves_all_as_it_was(seed, mask, unknown):
    envs, twin = WORLDS, TWIN
    for one in (envs, twin):
        one.reset(seed=11)
    options = {} if isinstance(mask, str) else {"reset_mask": mask}
    options |= {"start": "random"} if unknown else {}
    try:
        images, info = envs.reset(seed=seed, options=dict(options))
    except (ValueError, TypeError) as error:
        said = str(error)
    else:
        said = ""
    if said:
        assert any(word in said for word in ("seed", "reset_mask", "no option 'start'"))
        assert "must" in said or "it has:" in said
        # Everything goes on as if nothing had been asked for.
        for one in (envs, twin):
            one.step(np.full((3, 2), 0.1))
        assert_same(envs.reset(), twin.reset())
        return
    expected = SYNC
    expected.reset(seed=11)
    plain = int(seed) if isinstance(seed, np.integer) else seed
    plain = [None if one is None else int(one) for one in plain] if isinstance(plain, np.ndarray | tuple) else plain
    assert_same((images, info), expected.reset(seed=plain, options=dict(options)))
    assert_same(envs.reset(), expected.reset())


WORLDS, TWIN = (ls3_envs.GymVectorEnv("navigation", 3, horizon=5) for _ in range(2))
SYNC = SyncVectorEnv([lambda: gymnasium.make(NAVIGATION, horizon=5)] * 3)

#: Gymnasium's actions: shapes that broadcast, dtypes that can be read, values in and outside the box.
ARRAYS = st.builds(
    lambda shape, dtype, values: np.resize(np.array(values), shape).astype(dtype),
    st.sampled_from([(3, 2), (1, 2), (2,), (3, 1), (3, 3), (), (2, 3), (3, 2, 1), (6,)]) | st.just((3, 2)),
    st.sampled_from([np.float32, np.float64, np.float16, np.int64, np.int8, bool, complex, object, str]),
    st.lists(st.sampled_from([0.0, 1.0, -1.0, 0.25, 1.00002, 1.01, -2.0]), min_size=1, max_size=6),
) | st.sampled_from(
    [
        np.array([[np.nan, 0], [0, 0], [0, 0]]),
        np.full((3, 2), np.inf),
        np.full((3, 2), 1e300),
        np.full((3, 2), 2**62),
        [[0.1, 0.2], [0, 0], [1, 1]],
        [[0.1], [0.2, 0.3], []],
        None,
        "up",
        {"action": 1},
    ]
)


@settings(max_examples=150)
@given(action=ARRAYS)
def test_an_action_is_what_it_is_in_float32_or_is_refused_and_leaves_all_as_it_was(action):
    envs, twin = WORLDS, TWIN
    for one in (envs, twin):
        one.reset(seed=5)
    still = np.zeros((3, 2), np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        said = ""
        try:
            found = envs.step(action)
        except (ValueError, TypeError) as error:
            said = str(error)
        if said:
            assert "action" in said
            assert "(3, 2)" in said or "-1 to 1" in said
            assert_same(envs.step(still), twin.step(still))
            assert envs._batch.seen["state"].dtype == twin._batch.seen["state"].dtype
            return
    canonical = np.asarray(action).astype(np.float32)
    assert canonical.shape == (3, 2)
    assert np.abs(canonical).max() < 1.0001
    assert_same(found, twin.step(canonical))
    assert_same(envs.step(still), twin.step(still))


@pytest.mark.parametrize(
    "action", [np.zeros((1, 2)), 0.0, [0.0], [0.0, 0.0, 0.0], [np.nan, 0.0], [1.5, 0.0], None, [True, False]]
)
def test_one_environment_refuses_in_the_same_terms(action):
    env, twin = (ls3_envs.GymEnv("navigation") for _ in range(2))
    for one in (env, twin):
        one.reset(seed=0)
    with pytest.raises((ValueError, TypeError), match=r"shape \(2,\)|-1 to 1"):
        env.step(action)
    assert_same(env.step(np.array([0, 1])), twin.step(np.array([0.0, 1.0], np.float32)))


def test_the_action_of_one_that_starts_anew_may_be_anything_of_the_right_shape():
    envs = ls3_envs.GymVectorEnv("navigation", 2, horizon=2)
    envs.reset(seed=0)
    for _ in range(2):
        envs.step(np.zeros((2, 2)))
    _, reward, *_ = envs.step(np.full((2, 2), np.nan))
    assert reward.tolist() == [0.0, 0.0]


# Flags


@pytest.mark.parametrize("gym_id", IDS)
def test_infos_hold_numpy_bools_and_a_cost(gym_id):
    env = gymnasium.make(gym_id, horizon=3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, info = env.reset(seed=0)
        infos = [info, env.step(env.action_space.sample())[-1]]
    physics = set() if gym_id == NAVIGATION else {"physics_error"}
    for info in infos:
        assert set(info) == {"constraint", "success", "cost"} | physics
        assert all(info[key].dtype == bool and info[key].shape == () for key in set(info) - {"cost"})
        assert isinstance(info["cost"], float)
        assert info["cost"] == float(info["constraint"])


def test_the_cost_is_one_while_the_constraint_is_violated():
    env = gymnasium.make(NAVIGATION)
    env.reset(seed=0)
    costs = [env.step(np.array([1.0, 0.0], np.float32))[-1]["cost"] for _ in range(30)]
    assert costs == sorted(costs)
    assert set(costs) == {0.0, 1.0}


def test_an_info_is_the_users_own():
    env = ls3_envs.GymEnv("navigation")
    _, info = env.reset(seed=0)
    info["constraint"][...] = True
    assert not env._info()["constraint"]


@pytest.mark.parametrize("gym_id", [NAVIGATION, "ls3/Reacher-v0"])
def test_torchrl_reads_the_flags(gym_id):
    env = TorchRLGymEnv(gym_id).auto_register_info_dict()
    check_env_specs(env)
    episode = env.rollout(2)["next"]
    assert episode["constraint"].dtype == episode["success"].dtype == torch_bool()
    assert episode["cost"].tolist() == [0.0, 0.0]


def torch_bool():
    import torch

    return torch.bool


# Misuse and settings


def test_steps_and_pictures_before_the_first_reset_are_refused():
    for env, action in (
        (ls3_envs.GymEnv("navigation", render_mode="rgb_array"), np.zeros(2)),
        (ls3_envs.GymVectorEnv("navigation", 2, render_mode="rgb_array"), np.zeros((2, 2))),
    ):
        with pytest.raises(ResetNeeded, match=r"step was called before the first reset\. Call reset\(\) first"):
            env.step(action)
        with pytest.raises(ResetNeeded, match="render was called"):
            env.render()
    with pytest.raises(ResetNeeded, match="reset with a mask"):
        env.reset(options={"reset_mask": np.array([True, False])})


def test_steps_after_the_end_stay_truncated_until_a_reset():
    env = ls3_envs.GymEnv("navigation", horizon=2)
    env.reset(seed=0)
    assert [env.step(np.zeros(2))[3] for _ in range(4)] == [False, True, True, True]
    env.reset()
    assert not env.step(np.zeros(2))[3]


def test_closing_twice_is_harmless():
    for env in (ls3_envs.GymEnv("navigation"), ls3_envs.GymVectorEnv("navigation", 2), gymnasium.make(NAVIGATION)):
        env.close()
        env.close()


@pytest.mark.parametrize("gym_id", IDS)
def test_gymnasiums_spec_says_the_horizon(gym_id):
    horizon = ls3_envs.make(IDS[gym_id], seed=0).base_env.horizon
    assert gymnasium.spec(gym_id).max_episode_steps == horizon == ls3_envs.DOMAINS[IDS[gym_id]].horizon
    env = gymnasium.make(gym_id)
    assert env.spec.max_episode_steps == horizon
    check_env(env.unwrapped, skip_render_check=True)


def test_episodes_have_the_horizons_length_and_end_once():
    env = gymnasium.make(NAVIGATION)
    for _ in range(2):
        env.reset(seed=0)
        ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(100)]
        assert ends == [(False, False)] * 99 + [(False, True)]
    assert str(env).count("TimeLimit") == 1


def test_a_longer_horizon_that_gymnasium_cuts_is_said_with_the_remedy():
    env = gymnasium.make(NAVIGATION, horizon=103)
    env.reset(seed=0)
    assert [env.step(np.zeros(2, np.float32))[3] for _ in range(100)][-1]
    with pytest.warns(UserWarning, match="after 100 steps.* although horizon=103.*Pass max_episode_steps=103, too"):
        env.reset()
    longer = gymnasium.make(NAVIGATION, horizon=103, max_episode_steps=103)
    longer.reset(seed=0)
    assert [longer.step(np.zeros(2, np.float32))[3] for _ in range(103)] == [False] * 102 + [True]
    longer.reset()
    envs = gymnasium.make_vec(NAVIGATION, num_envs=1, horizon=103)
    envs.reset(seed=0)
    with pytest.warns(UserWarning, match="Pass max_episode_steps=103, too"):
        ends = [envs.step(np.zeros((1, 2), np.float32))[3][0] for _ in range(100)]
    assert ends == [False] * 99 + [True]


@pytest.mark.parametrize("name", ls3_envs.DOMAINS)
def test_frames_for_videos_are_larger_and_observations_as_they_were(name):
    large, small = (ls3_envs.GymEnv(name, render_mode="rgb_array", render_size=size) for size in (128, None))
    for _ in range(2):
        assert_same(large.reset(seed=1), small.reset(seed=1))
        one, other = large.render(), small.render()
        assert one.shape == (128, 128, 3)
        assert one.dtype == np.uint8
        # The same scene: four pixels of the larger one are about one of the smaller.
        coarse = one.reshape(64, 2, 64, 2, 3).mean((1, 3))
        assert np.abs(coarse - other).mean() < 4
        assert not (one[::2] == one[1::2]).all()  # drawn anew, not blown up
        assert_same(large.step(np.array([0.5, 0.2])), small.step(np.array([0.5, 0.2])))
    envs = ls3_envs.GymVectorEnv(name, 2, render_mode="rgb_array", render_size=128)
    envs.reset(seed=1)
    assert [frame.shape for frame in envs.render()] == [(128, 128, 3)] * 2


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"render_size": 4}, ValueError, "render_size must be at least 8 pixels, got 4"),
        ({"render_size": 4096}, ValueError, "render_size must be at most 1024 pixels, got 4096"),
        ({"render_size": 25.6}, TypeError, "render_size must be a whole number"),
        ({"autoreset_mode": "Never"}, ValueError, "'NextStep', 'SameStep', 'Disabled', got 'Never'"),
        ({"max_episode_steps": 0}, ValueError, "max_episode_steps must be at least 1, got 0"),
        ({"num_envs": 0}, ValueError, "num_envs must be at least 1, got 0"),
        (
            {"horizn": 3},
            TypeError,
            "unexpected keyword argument 'horizn'. It has: num_envs, start, .*Did you mean 'horizon'",
        ),
    ],
)
def test_settings_that_cannot_be_right_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        ls3_envs.GymVectorEnv("navigation", **options)
