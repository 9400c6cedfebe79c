"""Physics of many worlds: repeatable, independent of the batch, alike in both back ends."""

import mujoco
import numpy as np
import pytest
import torch

from ls3_envs.mujoco import MujocoPhysics, WarpPhysics, make_physics
from ls3_envs.pushing import pushing_model
from ls3_envs.reacher import reacher_model

MODELS = {"reacher": reacher_model(), "gripper": pushing_model(), "peg": pushing_model("peg")}


def states_and_controls(model: mujoco.MjModel, worlds: int, substeps: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(0)
    rest = np.concatenate([model.qpos0, np.zeros(model.nv)])
    state = np.tile(rest, (worlds, 1))
    state[:, -model.nv :] = 0.01 * rng.normal(size=(worlds, model.nv))
    control = rng.uniform(-0.1, 0.1, (worlds, substeps, model.nu))
    if model.nq > 2:  # the pushing hand, told where to be: beside the middle block, moving into it
        state[:, 21:23] = (0.0, -0.055)
        control = np.array([0.0, -0.055]) + np.linspace(0, 1, substeps)[:, None] * rng.uniform(
            0.0, 0.02, (worlds, 1, 2)
        )
    return torch.from_numpy(state), torch.from_numpy(control)


def test_a_step_is_mj_step_repeated():
    model = reacher_model()
    state, control = states_and_controls(model, 3, 4)
    moved = MujocoPhysics(model, threads=1)(state, control)
    for row in range(3):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = np.split(state[row].numpy(), [model.nq])
        for u in control[row].numpy():
            data.ctrl[:] = u
            mujoco.mj_step(model, data)
        assert np.array_equal(moved[row].numpy(), np.concatenate([data.qpos, data.qvel]))


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_the_same_bits_whatever_the_batch_and_the_number_of_threads(model):
    state, control = states_and_controls(model, 6, 10)
    whole = MujocoPhysics(model, threads=1)(state, control)
    assert torch.equal(MujocoPhysics(model, threads=3)(state, control), whole)
    parts = MujocoPhysics(model, threads=2)
    assert torch.equal(torch.cat([parts(state[i : i + 2], control[i : i + 2]) for i in (0, 2, 4)]), whole)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_warp_follows_c_mujoco_closely(model):
    state, control = states_and_controls(model, 2, 8)
    exact = MujocoPhysics(model, threads=1)(state, control)
    warp = WarpPhysics(model, 2, torch.device("cpu"))
    found = warp(state, control)
    assert found.dtype == torch.float64
    gap = (found - exact).abs()
    assert gap[:, : model.nq].max() < (1e-4 if model.nq == 2 else 1e-3)
    assert gap[:, model.nq :].max() < (1e-4 if model.nq == 2 else 0.02)  # resting contacts tremble
    # No memory of the step before.
    assert torch.equal(warp(state, control), found)


def test_a_world_that_blows_up_says_so_and_leaves_the_others_alone():
    model = reacher_model()
    state, control = states_and_controls(model, 3, 2)
    exact = MujocoPhysics(model, threads=1)(state, control)
    state[1, 0] = torch.nan
    moved = MujocoPhysics(model, threads=1)(state, control)
    assert not moved[1].isfinite().all()
    assert torch.equal(moved[[0, 2]], exact[[0, 2]])


def test_what_the_state_does_not_hold_is_refused():
    xml = """<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>
    <actuator><general joint="j" dyntype="integrator"/></actuator></mujoco>"""
    with pytest.raises(ValueError, match="1 state variables beyond positions and velocities"):
        MujocoPhysics(mujoco.MjModel.from_xml_string(xml))


def test_an_unknown_back_end_is_answered_with_the_known_ones():
    with pytest.raises(ValueError, match="'mujoco', 'warp', got 'bullet'"):
        make_physics("bullet", reacher_model(), num_envs=1, device=torch.device("cpu"), threads=1)
