"""Reacher: a two-link arm swings its finger to a goal round a stay-out disc (supplement, section 1.3.2)."""

from __future__ import annotations

import math
from typing import Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

from ls3_envs.mujoco import MujocoEnv
from ls3_envs.mujoco.env import PhysicsName, RendererName

LINK = 0.12
FINGER_RADIUS = 0.01
GOAL = (0.25 * math.sin(-0.25 * math.pi), 0.25 * math.cos(-0.25 * math.pi))
#: The suite's own: target and finger touch.
GOAL_RADIUS = 0.015 + FINGER_RADIUS
OBSTACLE = (0.13 * math.sin(-0.3 * math.pi), 0.13 * math.cos(-0.3 * math.pi))
OBSTACLE_RADIUS = 0.05 + FINGER_RADIUS
START = (0.53 * math.pi, 0.85 * math.pi)
#: Torque of an action, as a fraction of the suite's.
ACTION_SCALE = 0.5
HORIZON = 100
#: How likely an episode that starts at random starts near the task's start, and how near, in radians: where an agent
#: sets out must be among the violating data, and what starts anywhere is rarely there.
NEAR_START, NEARNESS = 0.5, 0.5


def reacher_model() -> mujoco.MjModel:
    """The two-link arm with this task's goal and stay-out disc, in flat colours, as a compiled model.

    Links, joints, motors, walls and cameras are those of dm_control's reacher, a test holds them equal; its lights,
    textures and materials are left out.
    """
    # Sizes and constants: dm_control.suite.reacher (DeepMind, Apache-2.0).
    blue, gold = ".25 .3 .4 1", ".85 .65 .2 1"
    xml = f"""
<mujoco model="two-link planar reacher">
  <option timestep=".02">
    <flag contact="disable"/>
  </option>
  <visual>
    <headlight ambient=".5 .5 .5" diffuse=".5 .5 .5" specular="0 0 0"/>
    <quality shadowsize="2048"/>
  </visual>
  <default>
    <joint type="hinge" axis="0 0 1" damping=".01"/>
    <motor gear=".05" ctrlrange="-1 1" ctrllimited="true"/>
  </default>
  <worldbody>
    <camera name="fixed" pos="0 0 .75"/>
    <geom name="ground" type="plane" size=".3 .3 10" rgba=".1 .15 .25 1"/>
    <geom name="wall_x" type="plane" pos="-.3 0 .02" zaxis="1 0 0" size=".02 .3 .02" rgba="{blue}"/>
    <geom name="wall_y" type="plane" pos="0 -.3 .02" zaxis="0 1 0" size=".3 .02 .02" rgba="{blue}"/>
    <geom name="wall_neg_x" type="plane" pos=".3 0 .02" zaxis="-1 0 0" size=".02 .3 .02" rgba="{blue}"/>
    <geom name="wall_neg_y" type="plane" pos="0 .3 .02" zaxis="0 -1 0" size=".3 .02 .02" rgba="{blue}"/>
    <geom name="root" type="cylinder" fromto="0 0 0 0 0 .02" size=".011" rgba=".5 .4 .2 1"/>
    <geom name="target" type="cylinder" pos="{GOAL[0]!r} {GOAL[1]!r} .001" size=".02 .001" rgba=".1 .9 .2 1"/>
    <!-- Flat, so that it never hides the arm. -->
    <geom name="obstacle" type="cylinder" pos="{OBSTACLE[0]!r} {OBSTACLE[1]!r} .001"
          size="{OBSTACLE_RADIUS - FINGER_RADIUS!r} .001" rgba=".9 .1 .1 1"/>
    <body name="arm" pos="0 0 .01">
      <joint name="shoulder"/>
      <geom name="arm" type="capsule" fromto="0 0 0 {LINK} 0 0" size=".01" rgba="{gold}"/>
      <body name="hand" pos="{LINK} 0 0">
        <joint name="wrist" range="-160 160" limited="true"/>
        <geom name="hand" type="capsule" fromto="0 0 0 .1 0 0" size=".01" rgba="{gold}"/>
        <body name="finger" pos="{LINK} 0 0">
          <camera name="hand" pos="0 0 .2" mode="track"/>
          <geom name="finger" type="sphere" size="{FINGER_RADIUS}" rgba=".2 .7 1 1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder"/>
    <motor name="wrist" joint="wrist"/>
  </actuator>
</mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


def finger_position(state: Tensor) -> Tensor:
    """Where the finger is, ``[*B, 2]`` in metres, for states ``[*B, 4]``."""
    shoulder, elbow = state[..., 0], state[..., 0] + state[..., 1]
    return LINK * torch.stack([shoulder.cos() + elbow.cos(), shoulder.sin() + elbow.sin()], -1)


class ReacherEnv(MujocoEnv):
    """The two-link reacher of dm_control's suite with a stay-out disc between start and goal.

    Actions are torques at shoulder and wrist, in ±1, halved before they are applied. The arm starts bent at
    (.53π, .85π); the goal set, top left, is where the finger touches the target; the finger may not touch the red disc,
    else the arm freezes. One picture shows no velocity: stack three (``ls3_envs.make("reacher")`` does).

    Deviation: the target is drawn green and .02 instead of .015 in radius, so that 64 pixels show it beside the red
    disc.

    Args:
        num_envs: N.
        start: ``"fixed"`` for the paper's start, ``"random"`` for near it or, as often, anywhere, at rest.
        horizon: steps in an episode.
        image_size: side of the image in pixels.
        physics: ``"mujoco"``, or ``"warp"`` for a GPU.
        renderer: ``"raytrace"``, or ``"egl"``.
        threads: that share the physics; the cores that this process may use when ``None``.
        device: of states and pictures.
        seed: of the environments' random streams.

    Returns:
        From ``step``: the keys of :class:`~ls3_envs.mujoco.MujocoEnv`; ``state`` holds two angles in radians and their
        speeds.

    Raises:
        ValueError: for an unknown ``start``, and as the base classes do.

    Example:
        >>> env = ReacherEnv(num_envs=2, seed=0)
        >>> env.rollout(3)["next", "pixels"].shape
        torch.Size([2, 3, 3, 64, 64])
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        start: Literal["fixed", "random"] = "fixed",
        horizon: int = HORIZON,
        image_size: int = 64,
        physics: PhysicsName = "mujoco",
        renderer: RendererName = "raytrace",
        threads: int | None = None,
        device: torch.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        if start not in ("fixed", "random"):
            raise ValueError(f"start must be 'fixed' or 'random', got {start!r}.")
        self.start = start
        super().__init__(
            reacher_model(),
            "fixed",
            num_envs=num_envs,
            action_low=(-1.0, -1.0),
            action_high=(1.0, 1.0),
            horizon=horizon,
            image_size=image_size,
            physics=physics,
            renderer=renderer,
            threads=threads,
            device=device,
            seed=seed,
        )

    def _initial_state(self, index: int, generator: np.random.Generator) -> Tensor:
        if self.start == "fixed":
            return torch.tensor([*START, 0.0, 0.0])
        low, high = np.array([-math.pi, -0.85 * math.pi]), np.array([math.pi, 0.85 * math.pi])
        if generator.random() < NEAR_START:
            low, high = np.maximum(low, np.array(START) - NEARNESS), np.minimum(high, np.array(START) + NEARNESS)
        while True:
            angles = generator.uniform(low, high)
            state = torch.tensor([*angles, 0.0, 0.0])
            if not self._violates(state):
                return state

    def _control(self, state: Tensor, action: Tensor) -> Tensor:
        return (ACTION_SCALE * action).unsqueeze(1)

    def _distance(self, state: Tensor, place: tuple[float, float]) -> Tensor:
        return (finger_position(state) - state.new_tensor(place)).norm(dim=-1, keepdim=True)

    def _violates(self, state: Tensor) -> Tensor:
        return self._distance(state, OBSTACLE) < OBSTACLE_RADIUS

    def _succeeds(self, state: Tensor) -> Tensor:
        return self._distance(state, GOAL) <= GOAL_RADIUS
