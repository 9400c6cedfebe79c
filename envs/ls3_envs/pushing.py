"""Sequential pushing: a hand pushes three blocks back, one after another, but not off the table (section 1.3.3)."""

from __future__ import annotations

from typing import Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

from ls3_envs.mujoco import MujocoEnv
from ls3_envs.mujoco.env import PhysicsName, RendererName

#: Half sides of the table top; the far edge, off which no block may fall, is at y = 0.2.
TABLE = (0.3, 0.2)
BLOCK_SIDE = 0.06
#: Where the blocks stand in a row, with clear gaps between them.
BLOCKS_X = (-0.15, 0.0, 0.15)
BLOCKS_Y = 0.0
#: Past this line a block is in its goal.
GOAL_Y = 0.075
HAND_START = (0.0, -0.14)
#: Half sides of the gripper, along x and y: about as wide as open jaws that would take a block.
GRIPPER = (0.04, 0.012)
PEG_RADIUS = 0.018
#: The hand's middle stays on the table and in the picture: largest |x|, least and largest y.
HAND_X, HAND_Y = 0.27, (-0.175, 0.185)
MAX_STEP = 0.05
START_STD = 0.003
#: How likely each block is in its goal already when an episode starts at random, and how likely an outer one stands
#: further out, by how much at most.
IN_GOAL_AT_RANDOM = 0.3
ASIDE_AT_RANDOM, ASIDE = 0.5, 0.14
SUBSTEPS = 40
HORIZON = 150

HandName = Literal["gripper", "peg"]

_HANDS: dict[HandName, str] = {
    "gripper": f'type="box" size="{GRIPPER[0]} {GRIPPER[1]} .03"',
    "peg": f'type="cylinder" size="{PEG_RADIUS} .03"',
}
_COLOURS = ("0.85 0.2 0.2", "0.95 0.75 0.15", "0.6 0.3 0.8")


def _block(number: int, x: float) -> str:
    half = BLOCK_SIDE / 2
    return f"""
    <body name="block{number}" pos="{x} {BLOCKS_Y} {half}">
      <freejoint/>
      <geom name="block{number}" type="box" size="{half} {half} {half}" mass=".1" rgba="{_COLOURS[number]} 1"/>
    </body>"""


def pushing_model(hand: HandName = "gripper") -> mujoco.MjModel:
    """Table, three blocks, a hand on two slides, and a camera above the table.

    The hand hangs on an arm that reaches in from the front and touches nothing: a hand alone is a dozen of 4,096
    pixels, which a VAE passes over.
    """
    width, depth = TABLE
    goal = (TABLE[1] - GOAL_Y) / 2
    xml = f"""
<mujoco model="sequential pushing">
  <option timestep=".005" integrator="implicitfast"/>
  <visual>
    <headlight ambient=".5 .5 .5" diffuse=".5 .5 .5" specular="0 0 0"/>
    <quality shadowsize="0"/>
  </visual>
  <default>
    <geom friction=".5"/>
    <position kp="2000" dampratio="1"/>
  </default>
  <worldbody>
    <camera name="above" pos="0 0 .72" fovy="52"/>
    <geom name="table" type="box" pos="0 0 -.05" size="{width} {depth} .05" rgba=".55 .5 .45 1"/>
    <geom name="goal" type="box" pos="0 {GOAL_Y + goal} .0005" size="{width} {goal} .0005" rgba=".35 .65 .4 1"
          contype="0" conaffinity="0"/>
    <geom name="floor" type="plane" pos="0 0 -.4" size="2 2 .1" rgba=".1 .12 .2 1"/>
    {"".join(_block(i, x) for i, x in enumerate(BLOCKS_X))}
    <body name="hand" pos="0 0 .035">
      <joint name="hand_x" type="slide" axis="1 0 0" range="-{HAND_X} {HAND_X}" limited="true"/>
      <joint name="hand_y" type="slide" axis="0 1 0" range="{HAND_Y[0]} {HAND_Y[1]}" limited="true"/>
      <geom name="hand" {_HANDS[hand]} mass=".5" rgba=".95 .95 .95 1"/>
      <geom name="arm" type="box" pos="0 -.25 .034" size=".012 .25 .004" mass="0" rgba=".95 .95 .95 1"
            contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <position joint="hand_x"/>
    <position joint="hand_y"/>
  </actuator>
</mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


def hand_position(state: Tensor) -> Tensor:
    """Where the hand is, ``[*B, 2]`` in metres, for states ``[*B, 43]``."""
    return state[..., 21:23]


def block_positions(state: Tensor) -> Tensor:
    """Where the blocks' centres are, ``[*B, 3, 3]`` in metres, for states ``[*B, 43]``."""
    return state[..., :21].unflatten(-1, (3, 7))[..., :3]


class SequentialPushingEnv(MujocoEnv):
    """Push every block back past the line, and none off the far edge of the table.

    Actions displace the hand by up to 5 cm along x and y, carried out over 0.2 s; it cannot leave the table. Success:
    all three blocks' centres are past 7.5 cm. Violation: one of them is past the far edge, 20 cm, or off the table
    otherwise, and everything freezes.

    Deviation: blocks of 6 cm stand 15 cm apart; the authors' are 8 cm wide and 5 cm apart, so that they overlap. 40
    substeps of 5 ms instead of 500: the end poses agree within 0.6 mm.

    Args:
        num_envs: N.
        hand: ``"gripper"``, 8 cm wide and flat: a block that it hits off its middle still goes straight on; or
            ``"peg"``, round and 3.6 cm wide: such a block turns and slips away.
        start: ``"fixed"`` has the hand in front of the blocks, with noise of 3 mm; ``"random"`` anywhere in front of
            them, each with probability .3 in its goal already, and an outer one with probability .5 up to 14 cm
            further out.
        horizon: steps in an episode.
        image_size: side of the image in pixels.
        physics: ``"mujoco"``, or ``"warp"`` for a GPU.
        renderer: ``"raytrace"``, or ``"egl"``.
        threads: that share the physics; the cores that this process may use when ``None``.
        device: of states and pictures.
        seed: of the environments' random streams.

    Returns:
        From ``step``: the keys of :class:`~ls3_envs.mujoco.MujocoEnv`; ``state`` holds the blocks' poses, the hand's
        place and all velocities, ``[N, 43]``.

    Raises:
        ValueError: for an unknown ``start`` or ``hand``, and as the base classes do.

    Example:
        >>> env = SequentialPushingEnv(num_envs=2, seed=0)
        >>> env.rollout(3)["next", "pixels"].shape
        torch.Size([2, 3, 3, 64, 64])
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        hand: HandName = "gripper",
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
        if hand not in _HANDS:
            raise ValueError(f"hand must be 'gripper' or 'peg', got {hand!r}.")
        self.start = start
        super().__init__(
            pushing_model(hand),
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
        self._rest = torch.as_tensor(np.concatenate([self.model.qpos0, np.zeros(self.model.nv)]))
        self._ramp = (torch.arange(1, SUBSTEPS + 1, dtype=torch.float64, device=self.device) / SUBSTEPS)[:, None]

    def _initial_state(self, index: int, generator: np.random.Generator) -> Tensor:
        state = self._rest.clone()
        place = generator.normal(HAND_START, START_STD)
        if self.start == "random":
            place = generator.uniform((-0.25, -0.18), (0.25, -0.06))
            there = generator.random(3) < IN_GOAL_AT_RANDOM
            y = np.where(there, generator.uniform(GOAL_Y + 0.01, TABLE[1] - 0.03, 3), BLOCKS_Y)
            state[1:21:7] = torch.as_tensor(y)
            aside = np.where(generator.random(3) < ASIDE_AT_RANDOM, generator.uniform(0.0, ASIDE, 3), 0.0)
            state[0:21:7] += torch.as_tensor(np.sign(BLOCKS_X) * aside)
        state[21:23] = torch.as_tensor(place)
        return state

    def _control(self, state: Tensor, action: Tensor) -> Tensor:
        # The target glides to its place: a jump of 5 cm would throw the blocks.
        x, y = (hand_position(state)[:, None] + self._ramp * action[:, None]).unbind(-1)
        return torch.stack([x.clamp(-HAND_X, HAND_X), y.clamp(*HAND_Y)], -1)

    def _violates(self, state: Tensor) -> Tensor:
        centres = block_positions(state)
        x, y, z = centres.unbind(-1)
        off = (y > TABLE[1]) | (z < 0.0) | (x.abs() > TABLE[0])
        return off.any(-1, keepdim=True)

    def _succeeds(self, state: Tensor) -> Tensor:
        return ((block_positions(state)[..., 1] > GOAL_Y).all(-1, keepdim=True)) & ~self._violates(state)
