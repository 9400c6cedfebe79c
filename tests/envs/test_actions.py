"""Actions of any shape, type and value: understood without doubt, or refused without a trace."""

import copy

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor
from torchrl.envs.utils import check_env_specs

import ls3_envs

NUMBERS = [torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.int8, torch.uint8]


def parts_of(env) -> dict[str, Tensor]:
    """All that a step changes."""
    names = ("_state", "_clock", "_frozen", "_broken")
    return {name: getattr(env, name).clone() for name in names if hasattr(env, name)}


def assert_identical(one: dict[str, Tensor], other: dict[str, Tensor]) -> None:
    for name, value in one.items():
        assert value.dtype == other[name].dtype, name
        assert torch.equal(value, other[name]), name


def worlds(name: str, num_envs: int = 3) -> tuple:
    env, twin = (ls3_envs.make(name, num_envs, frames=1, seed=4, horizon=6).base_env for _ in range(2))
    return env, twin


READY = {name: worlds(name) for name in ls3_envs.DOMAINS}


def assert_understood_or_refused(name: str, action: object) -> None:
    env, twin = READY[name]
    for one in (env, twin):
        one.set_seed(4)
        td = one.reset()
    before = parts_of(env)
    space = env.action_spec.space
    ask = td.clone()
    ask.batch_size = torch.Size([])
    ask.set("action", action)
    try:
        found = env._step(ask)
    except (ValueError, TypeError) as error:
        said = str(error)
        found = None
    if found is None:
        assert said.startswith("An action")
        assert "got" in said or "received" in said
        assert_identical(parts_of(env), before)
    else:
        canonical = action.to(torch.float32)
        assert canonical.shape == space.low.shape
        assert ((canonical >= space.low - 1.1e-4) & (canonical <= space.high + 1.1e-4)).all()
        expected = twin._step(td.clone().set("action", canonical))
        assert_identical(dict(found.items()), dict(expected.items()))
        assert_identical(parts_of(env), parts_of(twin))
        assert not env._state.requires_grad


@st.composite
def actions(draw, high: float) -> Tensor:
    shape = draw(st.sampled_from([(3, 2), (3, 2), (3, 2), (1, 2), (2,), (3, 1), (3, 3), (2, 3), (), (6,), (3, 2, 1)]))
    dtype = draw(st.sampled_from([*NUMBERS, torch.bool, torch.complex64]))
    values = st.floats(-high, high) | st.sampled_from(
        [high, -high, high + 5e-5, 1.01 * high + 1e-3, float("nan"), float("inf"), -1e300, 0.0, 1.0]
    )
    number = int(np.prod(shape))
    flat = torch.tensor(draw(st.lists(values, min_size=number, max_size=number)), dtype=torch.float64)
    if not dtype.is_floating_point and not dtype.is_complex:
        flat = flat.nan_to_num().clamp(-100, 100)
    action = flat.reshape(shape).to(dtype)
    return action.requires_grad_() if dtype == torch.float64 and draw(st.booleans()) else action


@settings(max_examples=300)
@given(action=actions(3.0))
@example(action=torch.zeros(3, 2, dtype=torch.float64))  # once made the state float64, for good
@example(action=torch.zeros(3, 2, dtype=torch.int64))
@example(action=torch.ones(3, 2, requires_grad=True))  # once kept the graph of every step
@example(action=torch.full((3, 2), 1e300, dtype=torch.float64))
def test_navigation(action):
    assert_understood_or_refused("navigation", action)


@settings(max_examples=15)
@given(action=actions(0.02), name=st.sampled_from(["reacher", "pushing", "cable_routing"]))
@example(action=torch.full((3, 2), 0.01, dtype=torch.float64, requires_grad=True), name="reacher")
def test_the_domains_with_physics(action, name):
    assert_understood_or_refused(name, action)


def test_a_tensordict_without_an_action_says_so():
    env = ls3_envs.NavigationEnv(2, seed=0)
    with pytest.raises(KeyError, match=r"no tensor 'action'\. Set it before"):
        env._step(env.reset())


def test_states_keep_their_type_over_an_episode_of_float64_actions():
    env, twin = (ls3_envs.NavigationEnv(2, seed=0) for _ in range(2))
    td, same = env.reset(), twin.reset()
    for t in range(5):
        action = torch.full((2, 2), 0.1 * t, dtype=torch.float64)
        td = env.step(td.set("action", action))["next"].exclude("reward")
        same = twin.step(same.set("action", action.float()))["next"].exclude("reward")
        assert_identical(dict(td.items()), dict(same.items()))
    check_env_specs(env)


@pytest.mark.parametrize("name", ["navigation", "reacher"])
@pytest.mark.parametrize("where", ["_advance", "_render", "_succeeds"])
def test_a_step_that_fails_midway_leaves_all_as_it_was(name, where, monkeypatch):
    env, twin = worlds(name)
    td, same = env.reset(), twin.reset()
    before = parts_of(env)

    def fail(*args):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(env, where, fail)
        with pytest.raises(KeyboardInterrupt):
            env._step(td.clone().set("action", torch.zeros(3, 2)))
    assert_identical(parts_of(env), before)
    steps = [e.step(t.set("action", torch.full((3, 2), 0.01)))["next"] for e, t in ((env, td), (twin, same))]
    assert_identical(*(dict(step.items()) for step in steps))


def test_a_reset_that_fails_leaves_the_running_episode_as_it_was(monkeypatch):
    env, _ = worlds("navigation")
    td = env.step(env.reset().set("action", torch.ones(3, 2)))["next"].exclude("reward")
    before = parts_of(env)
    with monkeypatch.context() as patch:
        patch.setattr(env, "_violates", lambda state: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            env.reset(td.clone().set("_reset", torch.tensor([[True], [False], [True]])))
    assert_identical(parts_of(env), before)


def test_environments_made_or_stepped_in_inference_mode_go_on_outside_of_it():
    with torch.inference_mode():
        env = ls3_envs.make("navigation", 2, seed=0)
        env.rollout(3)
    inside = env.rollout(3)
    other = ls3_envs.make("navigation", 2, seed=0)
    with torch.inference_mode():
        other.rollout(3)
    assert inside["state"].isfinite().all()
    other.reset()
    with pytest.raises(ValueError, match="shape"):
        env.base_env._step(env.reset().set("action", torch.zeros(2, 1)))


def test_steps_after_the_end_go_on_truncated_until_a_reset():
    env = ls3_envs.NavigationEnv(1, seed=0, horizon=2)
    td, ends = env.reset(), []
    for _ in range(4):
        td = env.step(td.set("action", torch.zeros(1, 2)))["next"].exclude("reward")
        ends.append(td["truncated"].item())
    assert ends == [False, True, True, True]
    assert not env.step(env.reset().set("action", torch.zeros(1, 2)))["next", "truncated"]


def test_an_environment_can_be_closed_twice():
    env = ls3_envs.make("navigation", 1, seed=0)
    env.close()
    env.close(raise_if_closed=False)


# Seeds of each world


def test_each_world_may_have_a_seed_of_its_own():
    env = ls3_envs.NavigationEnv(3, seed=1)
    env.set_seeds([7, None, 9])
    states = env.reset()["state"]
    assert torch.equal(states[0], ls3_envs.NavigationEnv(1, seed=7).reset()["state"][0])
    assert torch.equal(states[1], ls3_envs.NavigationEnv(3, seed=1).reset()["state"][1])
    assert torch.equal(states[2], ls3_envs.NavigationEnv(1, seed=9).reset()["state"][0])


@pytest.mark.parametrize(
    ("seeds", "error", "message"),
    [
        ([1, 2], ValueError, "seeds must be 3, one for each environment; got 2"),
        ([1, 2, -3], ValueError, r"seeds\[2\] must be at least 0, got -3"),
        ([1, 2.0, 3], TypeError, r"seeds\[1\] must be a whole number"),
    ],
)
def test_other_seeds_are_refused_and_change_nothing(seeds, error, message):
    env = ls3_envs.NavigationEnv(3, seed=1)
    before = copy.deepcopy(env)
    with pytest.raises(error, match=message):
        env.set_seeds(seeds)
    assert torch.equal(env.reset()["state"], before.reset()["state"])
