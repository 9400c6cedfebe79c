"""Cable routing: a grasped cable is laid over the goal and kept off the obstacle (supplement, section 1.3.4)."""

from __future__ import annotations

from typing import Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

from ls3_envs.mujoco import MujocoEnv, View
from ls3_envs.mujoco.env import PhysicsName, RendererName

LINKS = 16
LINK_LENGTH = 0.014
CABLE_RADIUS = 0.006
#: The grasped end at rest; the cable hangs from it towards smaller y.
START = (-0.13, -0.02)
GOAL = (0.12, 0.0)
GOAL_RADIUS = 0.02
OBSTACLE = (0.0, -0.03)
OBSTACLE_RADIUS = 0.035
#: The grasped end stays in the picture: largest |x|, least and largest y.
GRIP_X, GRIP_Y = 0.18, (-0.2, 0.16)
MAX_STEP = 0.02
START_STD = 0.002
SUBSTEPS = 20
HORIZON = 50

Observation = Literal["mask", "rgb"]


def _chain(number: int = 0) -> str:
    """Links ``number`` to the last, each a capsule on a hinge at the end of the one before."""
    if number == LINKS:
        return ""
    joint = (
        f'<joint name="hinge{number}" axis="0 0 1" stiffness=".02" damping=".002" armature="1e-6"/>' if number else ""
    )
    place = f"0 -{LINK_LENGTH} 0" if number else "0 0 0"
    return f"""<body pos="{place}">{joint}
      <geom name="link{number}" type="capsule" fromto="0 0 0 0 -{LINK_LENGTH} 0" size="{CABLE_RADIUS}" density="1000"
            rgba=".9 .1 .1 1" contype="0" conaffinity="0"/>
      {_chain(number + 1)}</body>"""


def cable_model() -> mujoco.MjModel:
    """A planar chain on a viscous table, its end on two slides, over a goal and an obstacle that it cannot touch."""
    disc = 'type="cylinder" contype="0" conaffinity="0"'
    xml = f"""
<mujoco model="cable routing">
  <option timestep=".005" integrator="implicitfast" gravity="0 0 0" viscosity="5" density="0"/>
  <visual>
    <headlight ambient=".5 .5 .5" diffuse=".5 .5 .5" specular="0 0 0"/>
    <quality shadowsize="0"/>
  </visual>
  <worldbody>
    <camera name="above" pos="0 -.03 .5" fovy="44"/>
    <geom name="table" type="plane" pos="0 0 -.01" size="1 1 .1" rgba=".85 .85 .85 1" contype="0" conaffinity="0"/>
    <geom name="goal" {disc} pos="{GOAL[0]} {GOAL[1]} -.008" size="{GOAL_RADIUS} .001" rgba=".1 .8 .2 1"/>
    <geom name="obstacle" {disc} pos="{OBSTACLE[0]} {OBSTACLE[1]} -.008" size="{OBSTACLE_RADIUS} .001"
          rgba=".1 .2 .9 1"/>
    <body name="gripper" pos="0 0 0">
      <joint name="grip_x" type="slide" axis="1 0 0" range="-{GRIP_X} {GRIP_X}" limited="true"/>
      <joint name="grip_y" type="slide" axis="0 1 0" range="{GRIP_Y[0]} {GRIP_Y[1]}" limited="true"/>
      <geom name="gripper" type="sphere" size=".008" mass=".1" rgba=".2 .2 .2 1" group="3" contype="0" conaffinity="0"/>
      {_chain()}
    </body>
  </worldbody>
  <actuator>
    <position joint="grip_x" kp="5000" dampratio="1"/>
    <position joint="grip_y" kp="5000" dampratio="1"/>
  </actuator>
</mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


class CableRoutingEnv(MujocoEnv):
    """Move a cable's grasped end so that the cable crosses the goal and never the obstacle.

    Actions displace the grasped end by up to 2 cm along x and y; it cannot leave the picture. Both checks are made on
    the picture, by colour masking as on the paper's robot: success where red cable covers the green disc, violation,
    which freezes everything, where it covers the blue one. The gripper is not drawn, so that it hides no cable.

    The paper's task is physical; this one is simulated: a chain of 16 capsules on hinges, lying on a table that drags.

    Args:
        num_envs: N.
        observation: ``"mask"``, the cable's segmentation mask in three equal channels as in the paper, or ``"rgb"``.
        horizon: steps in an episode.
        image_size: side of the image in pixels.
        physics: ``"mujoco"``, or ``"warp"`` for a GPU.
        renderer: ``"raytrace"``, or ``"egl"``.
        threads: that share the physics; the cores that this process may use when ``None``.
        device: of states and pictures.
        seed: of the environments' random streams.

    Returns:
        From ``step``: the keys of :class:`~ls3_envs.mujoco.MujocoEnv`; ``state`` holds the grasped end's place, the
        hinges' angles and all velocities, ``[N, 34]``.

    Raises:
        ValueError: for an unknown ``observation``, and as the base classes do.

    Example:
        >>> env = CableRoutingEnv(num_envs=2, seed=0)
        >>> env.rollout(3)["next", "pixels"].shape
        torch.Size([2, 3, 3, 64, 64])
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        observation: Observation = "mask",
        horizon: int = HORIZON,
        image_size: int = 64,
        physics: PhysicsName = "mujoco",
        renderer: RendererName = "raytrace",
        threads: int | None = None,
        device: torch.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        if observation not in ("mask", "rgb"):
            raise ValueError(f"observation must be 'mask' or 'rgb', got {observation!r}.")
        self.observation = observation
        super().__init__(
            cable_model(),
            "above",
            num_envs=num_envs,
            action_low=(-MAX_STEP, -MAX_STEP),
            action_high=(MAX_STEP, MAX_STEP),
            horizon=horizon,
            image_size=image_size,
            physics=physics,
            renderer=renderer,
            threads=threads,
            device=device,
            seed=seed,
        )
        links = [i for i in range(self.model.ngeom) if self.model.geom(i).name.startswith("link")]
        self._links = torch.tensor(links, device=self.device)
        self._ramp = (torch.arange(1, SUBSTEPS + 1, dtype=torch.float64, device=self.device) / SUBSTEPS)[:, None]
        # What lies under the cable never moves: rendered once, with the cable far outside the picture.
        away = torch.zeros(1, self.model.nq, dtype=torch.float64, device=self.device)
        away[0, :2] = 10.0
        empty = self.renderer(away).pixels[0]
        self._goal_mask, self._obstacle_mask = is_green(empty), is_blue(empty)

    def _initial_state(self, index: int, generator: np.random.Generator) -> Tensor:
        state = torch.zeros(self.model.nq + self.model.nv, dtype=torch.float64)
        state[:2] = torch.as_tensor(generator.normal(START, START_STD))
        return state

    def _control(self, state: Tensor, action: Tensor) -> Tensor:
        x, y = (state[:, None, :2] + self._ramp * action[:, None]).unbind(-1)
        return torch.stack([x.clamp(-GRIP_X, GRIP_X), y.clamp(*GRIP_Y)], -1)

    def _render(self, state: Tensor) -> Tensor:
        view = self._view(state)
        return view.pixels if self.observation == "rgb" else self._segment(view)

    def render_rgb(self) -> Tensor:
        """All as they are now, in colour."""
        return self._view(self._state).pixels

    def _segment(self, view: View) -> Tensor:
        mask = torch.isin(view.geoms, self._links).to(torch.uint8) * 255
        return mask[:, None].expand(-1, 3, -1, -1).contiguous()

    def _covers(self, state: Tensor, region: Tensor) -> Tensor:
        return (is_red(self._view(state).pixels) & region).flatten(1).any(-1, keepdim=True)

    def _violates(self, state: Tensor) -> Tensor:
        return self._covers(state, self._obstacle_mask)

    def _succeeds(self, state: Tensor) -> Tensor:
        return self._covers(state, self._goal_mask) & ~self._violates(state)


def _dominates(pixels: Tensor, channel: int) -> Tensor:
    """Bool ``[*B, S, S]``: one channel of the images ``[*B, 3, S, S]`` outshines both others."""
    bright = pixels.to(torch.int16)
    others = bright[..., [c for c in range(3) if c != channel], :, :].amax(-3)
    return bright[..., channel, :, :] > others + 80


def is_red(pixels: Tensor) -> Tensor:
    """Bool ``[*B, S, S]``: the cable's colour."""
    return _dominates(pixels, 0)


def is_green(pixels: Tensor) -> Tensor:
    """Bool ``[*B, S, S]``: the goal's colour."""
    return _dominates(pixels, 1)


def is_blue(pixels: Tensor) -> Tensor:
    """Bool ``[*B, S, S]``: the obstacle's colour."""
    return _dominates(pixels, 2)
