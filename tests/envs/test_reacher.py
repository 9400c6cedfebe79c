"""Reacher: geometry of section 1.3.2, seen and computed."""

import math
import re
from importlib.resources import files

import mujoco
import numpy as np
import pytest
import torch

from ls3_envs import ReacherEnv
from ls3_envs.reacher import (
    FINGER_RADIUS,
    GOAL,
    NEARNESS,
    OBSTACLE,
    OBSTACLE_RADIUS,
    START,
    finger_position,
    reacher_model,
)


def test_the_finger_is_where_mujoco_has_it():
    model = reacher_model()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(5):
        data.qpos[:] = rng.uniform(-2, 2, 2)
        mujoco.mj_kinematics(model, data)
        state = torch.tensor([*data.qpos, 0.0, 0.0])
        np.testing.assert_allclose(finger_position(state), data.geom("finger").xpos[:2], atol=1e-12)


def suites_model() -> mujoco.MjModel:
    """dm_control's own model with this task's goal, stay-out disc and colours, in place."""
    suite = files(pytest.importorskip("dm_control")) / "suite"
    names = ("skybox.xml", "visual.xml", "materials.xml")
    assets = {f"./common/{name}": (suite / "common" / name).read_bytes() for name in names}
    spec = mujoco.MjSpec.from_string((suite / "reacher.xml").read_text(), include=assets)
    for light in list(spec.lights):
        spec.delete(light)
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.5] * 3, [0.5] * 3
    spec.visual.headlight.specular = [0.0] * 3
    colours = {"ground": (0.1, 0.15, 0.25), "root": (0.5, 0.4, 0.2), "arm": (0.85, 0.65, 0.2)}
    colours |= {"hand": (0.85, 0.65, 0.2), "finger": (0.2, 0.7, 1.0), "target": (0.1, 0.9, 0.2)}
    for geom in spec.geoms:
        geom.material = ""
        geom.rgba = [*colours.get(geom.name, (0.25, 0.3, 0.4)), 1.0]
    target = spec.geom("target")
    target.type, target.pos, target.size = mujoco.mjtGeom.mjGEOM_CYLINDER, [*GOAL, 0.001], [0.02, 0.001, 0.0]
    spec.worldbody.add_geom(
        name="obstacle",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=[*OBSTACLE, 0.001],
        size=[OBSTACLE_RADIUS - FINGER_RADIUS, 0.001, 0.0],
        rgba=[0.9, 0.1, 0.1, 1.0],
    )
    return spec.compile()


def fields(part: object, prefix: str = "") -> dict[str, object]:
    """All numbers and arrays of a compiled model, those of ``opt``, ``vis`` and ``stat`` under dotted names."""
    found: dict[str, object] = {}
    for name in dir(part):
        value = None if name.startswith("_") else getattr(part, name)
        if isinstance(value, (bool, int, float, np.ndarray)):
            found[prefix + name] = value
        elif type(value).__module__.startswith("mujoco"):
            found |= fields(value, f"{prefix}{name}.")
    return found


def test_the_model_is_the_suites_without_its_textures_and_materials():
    ours, suites = fields(reacher_model()), fields(suites_model())
    assert ours.keys() == suites.keys()
    assert {"body_mass", "dof_damping", "geom_rgba", "opt.timestep", "vis.map.znear", "stat.extent"} <= ours.keys()
    assert len(ours) > 400
    # Textures, materials, and where names stand in memory, which comes after theirs.
    left_out = re.compile(r"n?(tex|mat)_?.*|name_(tex|mat|actuator)adr|names_map|nnames(_map)?|nbuffer|signature")
    different = [name for name in ours if not np.array_equal(ours[name], suites[name])]
    assert [name for name in different if not left_out.fullmatch(name)] == []
    # Nothing wears a material, so that leaving them out changes no picture.
    assert (suites["geom_matid"] == -1).all()


@pytest.mark.parametrize(
    ("kind", "count"),
    [("body", "nbody"), ("joint", "njnt"), ("geom", "ngeom"), ("camera", "ncam"), ("actuator", "nu")],
)
def test_everything_has_the_suites_name(kind, count):
    ours, suites = (
        [getattr(model, kind)(i).name for i in range(getattr(model, count))]
        for model in (reacher_model(), suites_model())
    )
    assert ours == suites
    assert all(ours)


def test_torques_are_half_the_suites():
    model = reacher_model()
    assert model.opt.timestep == 0.02
    assert model.actuator("shoulder").gear[0] == 0.05
    env = ReacherEnv(num_envs=1, seed=0)
    env.reset()
    start = env._state.clone()
    stepped = env.step(env.reset().set("action", torch.tensor([[1.0, -0.5]])))
    data = mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = start[0, :2], start[0, 2:], (0.5, -0.25)
    mujoco.mj_step(env.model, data)
    np.testing.assert_allclose(stepped["next", "state"][0], [*data.qpos, *data.qvel], rtol=1e-6)


def test_the_start_is_fixed_safe_and_not_in_the_goal():
    first = ReacherEnv(num_envs=3, seed=1).reset()
    expected = torch.tensor([0.53 * math.pi, 0.85 * math.pi, 0.0, 0.0]).expand(3, -1)
    torch.testing.assert_close(first["state"], expected)
    assert not first["constraint"].any()
    assert not first["success"].any()


def test_random_starts_are_safe_and_differ():
    first = ReacherEnv(num_envs=64, start="random", seed=1).reset()
    assert not first["constraint"].any()
    assert first["state"][:, :2].std(0).min() > 0.5
    assert (first["state"][:, 2:] == 0).all()
    near = ((first["state"][:, :2] - torch.tensor(START)).abs() <= NEARNESS + 1e-6).all(-1)
    assert 0.3 < near.float().mean() < 0.7  # half of them, and hardly any by chance


def test_goal_and_stay_out_disc_are_drawn_where_they_count():
    pixels = ReacherEnv(num_envs=1, seed=0).reset()["pixels"][0].float()
    green = (pixels[1] > pixels[0] + 60) & (pixels[1] > pixels[2] + 60)
    red = (pixels[0] > pixels[1] + 60) & (pixels[0] > pixels[2] + 100)
    for mask, (x, y) in ((green, GOAL), (red, OBSTACLE)):
        row, column = mask.nonzero().float().mean(0)
        # 64 pixels span 2 * .75 * tan(22.5°) = .621 m about the middle.
        assert abs((column - 31.5) * 0.621 / 64 - x) < 0.01
        assert abs((31.5 - row) * 0.621 / 64 - y) < 0.01


def test_an_unknown_start_is_refused():
    with pytest.raises(ValueError, match="'fixed' or 'random', got 'anywhere'"):
        ReacherEnv(start="anywhere")
