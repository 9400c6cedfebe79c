"""Pictures without a display: what is where, alike for any batch, and the same scene by both renderers."""

import os
import subprocess
import sys
import textwrap

import mujoco
import pytest
import torch

from ls3_envs.mujoco import RayTracer, make_renderer

MODEL = """
<mujoco>
  <visual>
    <headlight ambient=".5 .5 .5" diffuse=".5 .5 .5" specular="0 0 0"/>
  </visual>
  <worldbody>
    <camera name="above" pos="0 0 1" fovy="60"/>
    <geom name="floor" type="plane" size="1 1 .1" rgba="0 0 1 1"/>
    <body name="box">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 1 0"/>
      <geom name="box" type="box" size=".1 .1 .01" rgba="1 0 0 1" mass="1"/>
      <geom name="hidden" type="sphere" size=".3" group="3" mass="1"/>
    </body>
  </worldbody>
</mujoco>"""


def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL)


def test_a_box_is_where_it_stands_and_what_is_not_shown_hides_nothing():
    view = RayTracer(model(), "above", num_envs=2)(torch.tensor([[0.0, 0.0], [0.3, 0.3]]))
    assert view.pixels.shape == (2, 3, 64, 64)
    assert view.pixels.dtype == torch.uint8
    red = view.pixels[:, 0] > view.pixels[:, 2]
    rows, columns = (torch.stack([mask.nonzero()[:, i].float().mean() for mask in red]) for i in (0, 1))
    torch.testing.assert_close(rows[0], torch.tensor(31.5))
    torch.testing.assert_close(columns[0], torch.tensor(31.5))
    # y grows upwards in the scene and rows downwards in the picture; 64 pixels span 2 tan(30°) = 1.155 m.
    torch.testing.assert_close(columns[1] - columns[0], torch.tensor(0.3 / 1.1433 * 64), atol=1.0, rtol=0.0)
    torch.testing.assert_close(rows[0] - rows[1], torch.tensor(0.3 / 1.1433 * 64), atol=1.0, rtol=0.0)
    assert torch.equal(view.geoms == 1, red)
    assert set(view.geoms.unique().tolist()) == {0, 1}


def test_a_picture_is_the_same_in_any_batch():
    poses = 0.3 * torch.randn(5, 2)
    whole = RayTracer(model(), "above", num_envs=5)(poses)
    for worlds in (1, 3):
        parts = RayTracer(model(), "above", num_envs=worlds)(poses)
        assert torch.equal(parts.pixels, whole.pixels)
        assert torch.equal(parts.geoms, whole.geoms)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera": "side"}, "no camera 'side'; it has: above"),
        ({"size": 4}, r"8\.\.1024 pixels, got 4"),
        ({"name": "vulkan"}, "'raytrace', 'egl', got 'vulkan'"),
    ],
)
def test_what_cannot_be_drawn_is_refused(options, message):
    arguments = {"name": "raytrace", "camera": "above", "size": 64} | options
    with pytest.raises(ValueError, match=message):
        make_renderer(
            arguments["name"],
            model(),
            arguments["camera"],
            size=arguments["size"],
            num_envs=1,
            device=torch.device("cpu"),
        )


def test_egl_must_be_chosen_before_mujoco_is_imported(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with pytest.raises(RuntimeError, match=r"MUJOCO_GL=egl.*renderer=\"raytrace\""):
        make_renderer("egl", model(), "above", size=64, num_envs=1, device=torch.device("cpu"))


def in_a_fresh_process(code: str, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        env=os.environ | environment,
        check=False,
    )


def test_every_domain_runs_without_any_rendering_library():
    # Loading a library by one of these names fails, as on a machine that has none of them.
    done = in_a_fresh_process(
        """
        import ctypes, ctypes.util
        banned = ("libGL", "libEGL", "libOSMesa", "libOpenGL")
        load, find = ctypes.CDLL.__init__, ctypes.util.find_library
        def refuse(self, name, *args, **kwargs):
            if name is not None and any(word in str(name) for word in banned):
                raise OSError(f"{name}: cannot open shared object file")
            load(self, name, *args, **kwargs)
        ctypes.CDLL.__init__ = refuse
        ctypes.util.find_library = lambda name: None if name in ("GL", "EGL", "OSMesa", "OpenGL") else find(name)
        import ls3_envs
        for name in ls3_envs.DOMAINS:
            assert ls3_envs.make(name, num_envs=1, seed=0).rollout(2)["next", "pixels"].float().std() > 0, name
        maps = open("/proc/self/maps").read()
        assert not any(f"/{word}.so" in maps for word in ("libGL", "libEGL", "libOSMesa"))
        """,
        MUJOCO_GL="",
        DISPLAY="",
    )
    assert done.returncode == 0, done.stderr


def test_both_renderers_show_the_same_scene():
    done = in_a_fresh_process(
        """
        import torch
        from ls3_envs.reacher import ReacherEnv
        try:
            egl = ReacherEnv(num_envs=2, renderer="egl", seed=0)
        except RuntimeError as error:
            assert "raytrace" in str(error)
            raise SystemExit(77)
        traced = ReacherEnv(num_envs=2, seed=0)
        one, other = (env.reset()["pixels"].float() for env in (egl, traced))
        assert (one - other).abs().mean() < 2.0, (one - other).abs().mean()
        """,
        MUJOCO_GL="egl",
    )
    if done.returncode == 77:
        pytest.skip("this machine has no EGL")
    assert done.returncode == 0, done.stderr
