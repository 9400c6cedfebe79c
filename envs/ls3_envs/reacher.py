"""Reacher: a two-link arm swings its finger to a goal round a stay-out disc (supplement, section 1.3.2)."""

from __future__ import annotations

import math
from importlib.resources import files
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
#: Torque of an action, as a share of the suite's.
ACTION_SCALE = 0.5
HORIZON = 100


def reacher_model() -> mujoco.MjModel:
    """dm_control's reacher with this task's goal and stay-out disc, in flat colours."""
    # Read as files: importing dm_control's suite would load OpenGL.
    suite = files("dm_control") / "suite"
    names = ("skybox.xml", "visual.xml", "materials.xml")
    assets = {f"./common/{name}": (suite / "common" / name).read_bytes() for name in names}
    spec = mujoco.MjSpec.from_string((suite / "reacher.xml").read_text(), include=assets)
    for light in list(spec.lights):
        spec.delete(light)
    # Shading by the headlight alone: both renderers then agree.
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.5] * 3, [0.5] * 3
    spec.visual.headlight.specular = [0.0] * 3
    colours = {"ground": (0.1, 0.15, 0.25), "root": (0.5, 0.4, 0.2), "arm": (0.85, 0.65, 0.2)}
    colours |= {"hand": (0.85, 0.65, 0.2), "finger": (0.2, 0.7, 1.0), "target": (0.1, 0.9, 0.2)}
    for geom in spec.geoms:
        geom.material = ""
        geom.rgba = [*colours.get(geom.name, (0.25, 0.3, 0.4)), 1.0]
    target = spec.geom("target")
    target.type, target.pos, target.size = mujoco.mjtGeom.mjGEOM_CYLINDER, [*GOAL, 0.001], [0.02, 0.001, 0.0]
    # Flat, so that it never hides the arm.
    spec.worldbody.add_geom(
        name="obstacle",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=[*OBSTACLE, 0.001],
        size=[OBSTACLE_RADIUS - FINGER_RADIUS, 0.001, 0.0],
        rgba=[0.9, 0.1, 0.1, 1.0],
    )
    return spec.compile()


def finger_position(state: Tensor) -> Tensor:
    """Where the finger is, ``[*B, 2]`` in metres, for states ``[*B, 4]``."""
    shoulder, elbow = state[..., 0], state[..., 0] + state[..., 1]
    return LINK * torch.stack([shoulder.cos() + elbow.cos(), shoulder.sin() + elbow.sin()], -1)


class ReacherEnv(MujocoEnv):
    """dm_control's two-link reacher with a stay-out disc between start and goal.

    Actions are torques at shoulder and wrist, in ±1, halved before they are applied. The arm starts bent at
    (.53π, .85π); the goal set, top left, is where the finger touches the target; the finger may not touch the red disc,
    else the arm freezes. One picture shows no velocity: stack three (``ls3_envs.make("reacher")`` does).

    Deviation: the target is drawn green and .02 instead of .015 in radius, so that 64 pixels show it beside the red
    disc.

    Args:
        num_envs: N.
        start: ``"fixed"`` for the paper's start, ``"random"`` for anywhere at rest.
        horizon: steps in an episode.
        image_size: side of the image in pixels.
        physics: ``"mujoco"``, or ``"warp"`` for a GPU.
        renderer: ``"raytrace"``, or ``"egl"``.
        threads: that share the worlds' physics; the machine's cores when ``None``.
        device: of states and pictures.
        seed: of the worlds' random streams.

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

    def _initial_state(self, world: int, generator: np.random.Generator) -> Tensor:
        if self.start == "fixed":
            return torch.tensor([*START, 0.0, 0.0])
        while True:
            angles = generator.uniform((-math.pi, -0.85 * math.pi), (math.pi, 0.85 * math.pi))
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
