"""Environments in other processes: workers that live lives of their own, copies that go on alike, and cores."""

import copy
import multiprocessing
import os
import pickle
import subprocess
import sys
import textwrap
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import ParallelEnv

import ls3_envs
from ls3_envs import cores, seeding

STILL = np.zeros((3, 2), np.float32)


def first_states(connection, env, seed=None):
    """In a worker: where an environment's worlds start."""
    if seed is not None:
        torch.manual_seed(seed)
    env = env() if callable(env) and not isinstance(env, torch.nn.Module) else env
    connection.send(env.reset()["state"].tolist())


def in_workers(method: str, *environments) -> list:
    """What :func:`first_states` finds in one worker for each environment, or for what makes one."""
    context = multiprocessing.get_context(method)
    found = []
    for env in environments:
        here, there = context.Pipe(duplex=False)
        worker = context.Process(target=first_states, args=(there, env))
        worker.start()
        found.append(here.recv())
        worker.join()
    return found


def all_differ(states: list) -> bool:
    return len({str(state) for state in states}) == len(states)


def make_unseeded():
    return ls3_envs.make("navigation", 2)


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_gymnasiums_workers_without_a_seed_live_different_lives_and_with_one_the_same_again(context):
    envs = gymnasium.make_vec(
        "ls3/Navigation-v0", num_envs=3, vectorization_mode="async", vector_kwargs={"context": context}
    )
    try:
        images, _ = envs.reset()
        images = [images, *(envs.step(STILL)[0] for _ in range(2))][-1]
        assert all_differ([image.tobytes() for image in images])
        first, _ = envs.reset(seed=4)
        np.testing.assert_array_equal(envs.reset(seed=4)[0], first)
        alone, _ = gymnasium.make("ls3/Navigation-v0").reset(seed=6)
        np.testing.assert_array_equal(first[2], alone)
    finally:
        envs.close()


def test_torchrls_forked_workers_without_a_seed_live_different_lives():
    worlds = ParallelEnv(3, partial(ls3_envs.make, "navigation"), mp_start_method="fork")
    try:
        assert all_differ(worlds.reset()["state"].tolist())
    finally:
        worlds.close(raise_if_closed=False)


def test_one_made_before_the_fork_leaves_the_stream_that_its_copies_have_too():
    env = ls3_envs.make("navigation", 2)
    assert all_differ([*in_workers("fork", env, env), env.reset()["state"].tolist()])
    # ... also when it has been running, and when it is pickled on its way.
    assert all_differ([*in_workers("fork", env, env), *in_workers("spawn", env), env.reset()["state"].tolist()])


def test_with_a_seed_every_process_lives_the_same_life():
    env = ls3_envs.make("navigation", 2, seed=3)
    there = [*in_workers("fork", env, env), *in_workers("spawn", env)]
    here = env.reset()["state"].tolist()
    assert there == [here] * 3


def test_only_worlds_without_a_seed_of_their_own_leave_their_stream():
    env = ls3_envs.NavigationEnv(2)
    env.set_seeds([5, None])
    one, other = in_workers("fork", env, env)
    assert one[0] == other[0] == ls3_envs.NavigationEnv(1, seed=5).reset()["state"][0].tolist()
    assert one[1] != other[1]


def test_in_the_main_process_torchs_seed_decides_in_a_worker_the_operating_system():
    torch.manual_seed(5)
    here = make_unseeded().reset()["state"].tolist()
    torch.manual_seed(5)
    assert make_unseeded().reset()["state"].tolist() == here
    torch.manual_seed(5)
    there = in_workers("fork", make_unseeded, make_unseeded)
    assert all_differ([here, *there])


def test_a_worker_draws_from_torchs_generator_as_often_as_the_main_process(monkeypatch):
    torch.manual_seed(1)
    seeding.unused_seed()
    after = torch.rand(())
    monkeypatch.setattr(seeding._PROCESS, "is_worker", True)
    torch.manual_seed(1)
    seeding.unused_seed()
    assert torch.equal(torch.rand(()), after)


def test_no_seed_after_a_seed_is_no_seed():
    env = ls3_envs.NavigationEnv(1, seed=0)
    env.set_seed(None)
    assert not torch.equal(env.reset()["state"], ls3_envs.NavigationEnv(1, seed=0).reset()["state"])


# Copies


def steps_of(env, number: int) -> list:
    """What the next steps show, over an end of the episode."""
    seen, td = [], env._last
    for t in range(number):
        action = 0.5 * env.action_spec.space.high * (1 if t % 2 else -1)
        td = env.step(td.set("action", action))["next"].exclude("reward")
        if td["done"].any():
            td = env.reset(td.select())
        seen.append((td["state"].clone(), td["pixels"].clone()))
    env._last = td
    return seen


def same(one: list, other: list) -> bool:
    return all(torch.equal(a, b) for x, y in zip(one, other, strict=True) for a, b in zip(x, y, strict=True))


@pytest.mark.parametrize("how", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
@pytest.mark.parametrize("name", ls3_envs.DOMAINS)
def test_a_copy_goes_on_alike_and_shares_nothing(name, how):
    env = ls3_envs.make(name, 2, seed=2, horizon=5)
    last = env.step(env.reset().set("action", torch.zeros(2, 2)))["next"].exclude("reward")
    twin, fresh = how(env), how(env)
    env._last, twin._last, fresh._last = last, last.clone(), last.clone()
    expected = steps_of(env, 6)
    assert same(steps_of(twin, 6), expected)
    assert same(steps_of(fresh, 6), expected)  # neither life has touched the third


@pytest.mark.parametrize("name", ["navigation", "reacher"])
def test_gymnasiums_environments_and_vectors_can_be_copied(name):
    env, envs = ls3_envs.GymEnv(name), ls3_envs.GymVectorEnv(name, 2, horizon=3)
    env.reset(seed=1)
    envs.reset(seed=1)
    for one, action in ((env, np.full(2, 0.5)), (envs, np.full((2, 2), 0.5))):
        for twin in (copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
            np.testing.assert_array_equal(twin.step(action)[0], copy.deepcopy(one).step(action)[0])


def test_a_warp_simulation_can_be_copied():
    env = ls3_envs.ReacherEnv(num_envs=2, physics="warp", seed=0)
    td = env.reset().set("action", torch.full((2, 2), 0.3))
    assert torch.equal(copy.deepcopy(env).step(td.clone())["next", "state"], env.step(td)["next", "state"])


def test_demonstrators_can_be_copied():
    env, policy = ls3_envs.make("navigation", 2, seed=0), ls3_envs.NavigationDemonstrator(seed=0)
    td = env.reset()
    policy(td)
    twin = pickle.loads(pickle.dumps(policy))
    assert torch.equal(twin(td.clone())["action"], policy(td.clone())["action"])


def test_a_simulation_with_threads_goes_on_after_a_fork():
    env = ls3_envs.ReacherEnv(num_envs=4, threads=2, seed=0)
    td = env.reset().set("action", torch.full((4, 2), 0.3))
    expected = env.step(td.clone())["next", "state"]
    env.set_seed(0)
    env.reset()
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.write(writer, bytes(torch.equal(env.step(td)["next", "state"], expected)))
        finally:
            os._exit(0)
    os.close(writer)
    os.waitpid(child, 0)
    assert os.read(reader, 10) == bytes(True)
    os.close(reader)


# Cores


def test_a_pinned_process_has_the_cores_that_it_is_pinned_to(monkeypatch):
    monkeypatch.setattr(cores, "_quota", lambda cgroup: None)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 5, 6}, raising=False)
    assert cores.available_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 7)
    assert cores.available_cores() == 7
    monkeypatch.setattr(cores, "_quota", lambda cgroup: 1.5)
    assert cores.available_cores() == 2
    monkeypatch.setattr(cores, "_quota", lambda cgroup: 0.2)
    assert cores.available_cores() == 1


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"cpu.max": "200000 100000\n"}, 2.0),
        ({"cpu.max": "max 100000\n"}, None),
        ({"cpu/cpu.cfs_quota_us": "150000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 1.5),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, None),
        ({"cpu.max": "what is this"}, None),
        ({}, None),
    ],
)
def test_a_containers_quota_is_read(tmp_path: Path, files: dict, expected):
    (tmp_path / "cpu").mkdir()
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert cores._quota(tmp_path) == expected


def test_physics_shares_worlds_between_the_cores_that_there_are(monkeypatch):
    monkeypatch.setattr("ls3_envs.mujoco.physics.available_cores", lambda: 3)
    assert len(ls3_envs.ReacherEnv(seed=0).physics._data) == 3
    for wrong in (0, -1):
        with pytest.raises(ValueError, match=f"threads must be at least 1, got {wrong}"):
            ls3_envs.ReacherEnv(threads=wrong)
    with pytest.raises(TypeError, match="threads must be a whole number"):
        ls3_envs.ReacherEnv(threads=1.5)


# MUJOCO_GL


@pytest.mark.parametrize("value", ["osmesa", "egl", "glfw", "nonsense", "disable", "", "wgl"])
def test_whatever_mujoco_gl_says_all_domains_work_and_it_stays_as_it_was(value):
    code = """
        import os, warnings
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            import ls3_envs
        names = [w for w in said if "MUJOCO_GL" in str(w.message)]
        before = os.environ["MUJOCO_GL"]
        for name in ("navigation", "reacher"):
            ls3_envs.make(name, 1, seed=0).rollout(2)
        assert os.environ["MUJOCO_GL"] == before
        if before in ("nonsense", "wgl"):
            assert len(names) == 1 and f"MUJOCO_GL={before!r} does not work" in str(names[0].message)
            assert "Unset MUJOCO_GL, or set it to 'disable'" in str(names[0].message)
            try:
                ls3_envs.ReacherEnv(renderer="egl")
            except RuntimeError as error:
                assert "MUJOCO_GL=egl" in str(error) and "raytrace" in str(error)
            else:
                raise AssertionError
        if before in ("disable", ""):
            assert not names
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        env=os.environ | {"MUJOCO_GL": value},
        check=False,
    )
    assert done.returncode == 0, done.stderr
