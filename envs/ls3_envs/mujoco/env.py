"""The environment that the MuJoCo domains share: state in, substeps, flags, pictures."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Literal

import mujoco
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary

from ls3_envs.base import VisualConstraintEnv
from ls3_envs.mujoco.physics import make_physics
from ls3_envs.mujoco.rendering import Renderer, View, make_renderer

PhysicsName = Literal["mujoco", "warp"]
RendererName = Literal["raytrace", "egl"]

#: Speeds, in SI units, that nothing in these domains has: the simulation has blown up.
_ABSURD_SPEED = 1e4


class MujocoEnv(VisualConstraintEnv):
    """N copies of one MuJoCo model, each a row of positions and velocities in float64.

    What the state is after a step depends on its own state, action and random stream alone. With C MuJoCo
    and either renderer, the same seed gives the same bits whatever ``num_envs`` and ``threads`` are; MuJoCo Warp
    computes in float32 and follows it closely.

    One whose physics blows up goes back to its last good state, ends its episode (``truncated``) and says so under
    ``physics_error``, bool ``[N, 1]``; the others do not notice.

    Args:
        model: compiled.
        camera: name of the camera that the pictures are taken with.
        groups: geom groups that it sees.
        num_envs: N.
        action_low: smallest action per axis.
        action_high: largest action per axis.
        horizon: steps in an episode.
        image_size: side of the image in pixels.
        physics: ``"mujoco"``, or ``"warp"`` for a GPU.
        renderer: ``"raytrace"``, or ``"egl"``.
        threads: that C MuJoCo shares them between; the cores that this process may use when ``None``.
        device: of states and pictures.
        seed: of the environments' random streams.

    Raises:
        ValueError: for an unknown back end, renderer, camera or image size, and as the base class does.
        RuntimeError: when EGL is asked for where it does not work.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: str,
        *,
        groups: tuple[int, ...] = (0, 1, 2),
        num_envs: int,
        action_low: Sequence[float],
        action_high: Sequence[float],
        horizon: int,
        image_size: int = 64,
        physics: PhysicsName = "mujoco",
        renderer: RendererName = "raytrace",
        threads: int | None = None,
        device: torch.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        super().__init__(
            num_envs=num_envs,
            state_dim=model.nq + model.nv,
            action_low=action_low,
            action_high=action_high,
            horizon=horizon,
            image_size=image_size,
            device=device,
            seed=seed,
        )
        self.model = model
        self.physics = make_physics(physics, model, num_envs=num_envs, device=self.device, threads=threads)
        self._make_renderer = partial(
            make_renderer, renderer, camera=camera, num_envs=num_envs, device=self.device, groups=groups
        )
        self.renderer = self._make_renderer(model=model, size=image_size)
        self._large: tuple[int, Renderer] | None = None
        self.observation_spec["physics_error"] = Binary(shape=(num_envs, 1), dtype=torch.bool, device=self.device)
        self._state = self._state.double()
        self._broken = torch.zeros_like(self._frozen)
        self._seen: tuple[Tensor, View] | None = None

    @abstractmethod
    def _control(self, state: Tensor, action: Tensor) -> Tensor:
        """Controls of every substep ``[N, S, nu]``, float64, for states and actions in float64."""

    def _advance(self, state: Tensor, action: Tensor) -> Tensor:
        moved = self.physics(state, self._control(state, action.double()))
        speed = moved[:, self.model.nq :].abs().amax(-1, keepdim=True)
        sound = moved.isfinite().all(-1, keepdim=True) & (speed < _ABSURD_SPEED)
        self._broken = ~sound & ~self._frozen
        return torch.where(sound, moved, state)

    def _view(self, state: Tensor) -> View:
        """Picture and geoms of states; what was rendered last is kept, since several questions are asked of a state."""
        if self._seen is None or not torch.equal(self._seen[0], state):
            self._seen = (state.clone(), self.renderer(state[:, : self.model.nq]))
        return self._seen[1]

    def _render(self, state: Tensor) -> Tensor:
        return self._view(state).pixels

    def render_frames(self, size: int) -> Tensor:
        """All as they are now, in colour, drawn at another size: uint8 ``[N, 3, size, size]``, size 8 to 1024."""
        if self._large is None or self._large[0] != size:
            self._large = size, self._make_renderer(model=self.model, size=size)
        return self._large[1](self._state[:, : self.model.nq]).pixels

    def _observe(self) -> TensorDict:
        return super()._observe().set("physics_error", self._broken.clone())

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        self._broken = torch.zeros_like(self._broken) if mask is None else self._broken & ~mask.reshape(-1, 1)
        return super()._reset(tensordict, **kwargs)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        broken = self._broken
        try:
            return super()._step(tensordict)
        except BaseException:
            self._broken = broken
            raise

    def _stepped(self, action: Tensor) -> TensorDict:
        out = super()._stepped(action)
        self._frozen = self._frozen | self._broken
        for key in ("truncated", "done"):
            out.set(key, out[key] | self._broken)
        return out
