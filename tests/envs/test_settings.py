"""Settings of environments, rows and collections: what is understood, and what is refused before anything is done."""

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

import ls3_envs
from ls3_envs import Domain, Lazy, NavigationEnv, OfflineData, VisualConstraintEnv
from ls3_envs.demonstrators.navigation import NavigationDemonstrator

ANYTHING = (
    st.integers(-3, 6)
    | st.floats(allow_nan=True)
    | st.text(max_size=3)
    | st.booleans()
    | st.sampled_from([np.int64(2), np.uint8(3), np.array(2), torch.tensor(2), np.float32(2.0), [2], 10**30, ()])
)


def is_whole(value: object) -> bool:
    if isinstance(value, bool | str | float | list | tuple):
        return False
    return isinstance(value, int | np.integer) or (isinstance(value, np.ndarray | torch.Tensor) and value.ndim == 0)


@settings(max_examples=150)
@given(name=st.sampled_from(["num_envs", "horizon", "seed"]), value=ANYTHING)
@example(name="seed", value=2.5)  # was 2, silently
@example(name="seed", value=True)
@example(name="num_envs", value=np.int64(2))
def test_numbers_are_whole_and_large_enough_or_refused(name, value):
    if is_whole(value) and int(value) > 100 and name != "seed":
        return  # it would be allowed, and fill the memory
    if name == "seed" and value is None:
        return
    least = 0 if name == "seed" else 1
    if is_whole(value) and int(value) >= least:
        plain = NavigationEnv(**{"seed": 0, name: int(value)})
        assert torch.equal(NavigationEnv(**{"seed": 0, name: value}).reset()["state"], plain.reset()["state"])
        return
    kind = ValueError if is_whole(value) else TypeError
    with pytest.raises(kind, match=f"{name} must be .*at least {least}"):
        NavigationEnv(**{"seed": 0, name: value})


@pytest.mark.parametrize("device", ["cuda:99", "gpu", "cup", 3.5, "xla"])
def test_devices_that_are_not_there_are_refused(device):
    for ask in (
        lambda: NavigationEnv(device=device),
        lambda: ls3_envs.collect_offline("navigation", "success", episodes=1, device=device),
    ):
        with pytest.raises(ValueError, match=r"device .* cannot be used here: .*\. Use device='cpu', or one there is"):
            ask()


def test_an_unknown_option_is_answered_with_the_known_ones_and_the_nearest():
    with pytest.raises(TypeError, match=r"'horizont'\. It has: num_envs, start, horizon.*Did you mean 'horizon'\?"):
        ls3_envs.make("navigation", horizont=3)
    with pytest.raises(TypeError, match=r"'thread'\. It has: .*Did you mean 'threads'\?"):
        ls3_envs.make("reacher", thread=3)
    with pytest.raises(TypeError, match=r"Did you mean 'render_mode'\?|'rendermode'\. It has"):
        gymnasium.make("ls3/Navigation-v0", rendermode="rgb_array")


def test_an_unknown_domain_is_answered_with_the_nearest():
    with pytest.raises(ValueError, match=r"Unknown domain 'navigaton'.*Did you mean 'navigation'\?"):
        ls3_envs.make("navigaton")
    with pytest.raises(ValueError, match=r"Known domains: [\w, ]+\.$"):
        ls3_envs.make("chess")
    for name in (3, None, ["navigation"]):
        with pytest.raises(TypeError, match="A domain's name must be a string"):
            ls3_envs.make(name)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"episodes": 0}, ValueError, "episodes must be at least 1, got 0"),
        ({"episodes": 2.0}, TypeError, "episodes must be a whole number"),
        ({"episodes": True}, TypeError, "episodes must be a whole number"),
        ({"seed": -1}, ValueError, "seed must be at least 0, got -1"),
        ({"seed": 0.5}, TypeError, "seed must be a whole number"),
        ({"seed": None}, TypeError, "seed must be a whole number"),
        ({"kind": "rand"}, ValueError, "no offline data 'rand'; it has: constraint, success"),
    ],
)
def test_collections_are_checked_before_anything_is_simulated(options, error, message, monkeypatch):
    monkeypatch.setattr("ls3_envs.making.make", lambda *args, **kwargs: pytest.fail("simulated"))
    with pytest.raises(error, match=message):
        ls3_envs.collect_offline("navigation", **({"kind": "success"} | options))


def test_numpy_numbers_are_numbers():
    plain, other = (
        ls3_envs.collect_offline("navigation", "success", episodes=n, seed=s)
        for n, s in ((1, 2), (np.int64(1), np.int32(2)))
    )
    assert torch.equal(plain["action"], other["action"])


# Rows


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        (
            {"env": "NavigationEnv"},
            TypeError,
            "env must be the environment's class, or a Lazy of it; got 'NavigationEnv'",
        ),
        ({"gym_id": 3}, TypeError, "gym_id must be a string"),
        ({"offline": [1]}, TypeError, "offline must be a mapping, OfflineData by"),
        ({"offline": {"success": 50}}, TypeError, r"offline\['success'\] must be an OfflineData, got 50"),
        ({"frames": 1.5}, TypeError, "frames must be a whole number"),
        ({"frame_stride": "4"}, TypeError, "frame_stride must be a whole number"),
        ({"horizon": 0}, ValueError, "horizon must be at least 1 step, got 0"),
        ({"horizon": 10.0}, TypeError, "horizon must be a whole number"),
    ],
)
def test_rows_of_wrong_types_are_refused(wrong, error, message):
    with pytest.raises(error, match=message):
        Domain(**({"env": NavigationEnv, "gym_id": "mine/Test-v0"} | wrong))


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"episodes": 1.0}, TypeError, "episodes must be a whole number"),
        ({"policy": "demonstrator"}, TypeError, "policy must be the scripted policy's class"),
        ({"env_options": ["start"]}, TypeError, "env_options must be a mapping"),
        ({"env_options": {3: "start"}}, TypeError, "env_options must be a mapping"),
    ],
)
def test_offline_data_of_wrong_types_are_refused(wrong, error, message):
    with pytest.raises(error, match=message):
        OfflineData(**({"episodes": 1, "policy": NavigationDemonstrator} | wrong))


@pytest.mark.parametrize(
    ("name", "row", "error", "message"),
    [
        (3, Domain(NavigationEnv, "mine/Test-v0"), TypeError, "name must be a string, got 3"),
        ("", Domain(NavigationEnv, "mine/Test-v0"), ValueError, "must not be empty"),
        ("test", NavigationEnv, TypeError, r"must be described by a Domain\(env, gym_id"),
        (
            "test",
            Domain(partial(NavigationEnv, horizon=0), "mine/Test-v0"),
            ValueError,
            "horizon of .* at least 1 step",
        ),
        ("test", Domain(partial(NavigationEnv, horizon=2.5), "mine/Test-v0"), TypeError, "horizon of .* whole number"),
    ],
)
def test_wrong_registrations_leave_everything_as_it_was(name, row, error, message):
    before, ids = dict(ls3_envs.DOMAINS), set(gymnasium.registry)
    with pytest.raises(error, match=message):
        ls3_envs.register(name, row)
    assert dict(ls3_envs.DOMAINS) == before
    assert set(gymnasium.registry) == ids


class Short(NavigationEnv):
    """A domain of a user's own, with a default horizon."""

    def __init__(self, num_envs=1, *, horizon=7, device="cpu", seed=None):
        super().__init__(num_envs, horizon=horizon, device=device, seed=seed)


class Fixed(VisualConstraintEnv):
    """One that has no say in its horizon."""

    def __init__(self, num_envs=1, *, device="cpu", seed=None):
        raise NotImplementedError


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (Domain(Short, "mine/Test-v0"), 7),
        (Domain(partial(Short, horizon=5), "mine/Test-v0"), 5),
        (Domain(lambda num_envs, **options: Short(num_envs, **options), "mine/Test-v0"), None),
        (Domain(Fixed, "mine/Test-v0"), None),
        (Domain(Fixed, "mine/Test-v0", horizon=9), 9),
        (Domain(Lazy("ls3_envs.navigation:NavigationEnv"), "mine/Test-v0"), None),
        (Domain(Lazy("ls3_envs.navigation:NavigationEnv"), "mine/Test-v0", horizon=100), 100),
    ],
)
def test_gymnasiums_spec_of_ones_own_domain_says_its_horizon_as_far_as_it_is_known(row, expected):
    ls3_envs.register("test", row)
    try:
        assert gymnasium.spec("mine/Test-v0").max_episode_steps == expected
    finally:
        ls3_envs.unregister("test")


def test_frames_for_videos_of_ones_own_domain_are_enlarged():
    class Dots(NavigationEnv):
        render_frames = VisualConstraintEnv.render_frames

    env = Dots(2, seed=0)
    env.reset()
    frames = env.render_frames(128)
    assert frames.shape == (2, 3, 128, 128)
    assert frames.dtype == torch.uint8
    assert torch.equal(frames[..., ::2, ::2], env.render_rgb())


@pytest.mark.parametrize(
    ("std", "message"),
    [(-1.0, "must not be negative"), (float("nan"), "must be finite"), (float("inf"), "must be finite")],
)
def test_a_noise_without_a_size_is_refused(std, message):
    with pytest.raises(ValueError, match=message):
        NavigationDemonstrator(noise_std=std)
