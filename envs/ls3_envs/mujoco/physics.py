"""Physics of many worlds at once, by C MuJoCo on the CPU or by MuJoCo Warp on a GPU."""

from __future__ import annotations

import os
import weakref
from copy import copy
from functools import partial
from typing import Any, Protocol

import mujoco
import numpy as np
import torch
from mujoco.rollout import Rollout
from torch import Tensor

from ls3_envs._checks import whole_number
from ls3_envs.cores import available_cores

PHYSICS = ("mujoco", "warp")


class Physics(Protocol):
    """Moves worlds: a step is a pure function of state and control, whatever the other worlds do."""

    def __call__(self, state: Tensor, control: Tensor) -> Tensor:
        """States after the last substep.

        Args:
            state: positions and velocities ``[N, nq + nv]``, float64.
            control: of every substep, ``[N, S, nu]``, float64.

        Returns:
            ``[N, nq + nv]``, float64; not finite where the simulation blew up.
        """


_WITH_THREADS: weakref.WeakSet[MujocoPhysics] = weakref.WeakSet()
_LEFT_BEHIND: list[Rollout | None] = []


def _leave_threads_behind() -> None:
    """After a fork: threads did not come along, and their pool would wait for them for ever, even to be deleted."""
    for physics in _WITH_THREADS:
        _LEFT_BEHIND.append(physics._rollout)
        physics._rollout = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_threads_behind)


class MujocoPhysics:
    """C MuJoCo through ``mujoco.rollout``: the default, and on CPUs by far the fastest.

    Every step starts without the solver's warm start, so that the same state and control lead to the same bits
    whatever the batch and the number of threads.

    Args:
        model: compiled; it must have no state beyond positions and velocities.
        threads: that share the worlds; the cores that this process may use when ``None``.

    Raises:
        ValueError: for fewer than one thread, or a model with more state than positions and velocities.
        TypeError: for a number of threads that is not whole.
    """

    def __init__(self, model: mujoco.MjModel, *, threads: int | None = None) -> None:
        threads = available_cores() if threads is None else whole_number(threads, "threads")
        self.model = copy(model)
        # A simulation that blows up is to show it, instead of silently starting again.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        if size != 1 + model.nq + model.nv:
            raise ValueError(
                f"The model has {size - 1 - model.nq - model.nv} state variables beyond positions and velocities "
                "(activations, plugins or histories), which these environments do not carry along. Remove them."
            )
        self._threads = threads
        self._data = [mujoco.MjData(self.model) for _ in range(threads)]
        # A pool of one thread costs more than calling it here.
        self._make_rollout = partial(Rollout, nthread=threads if threads > 1 else 0)
        self._rollout: Rollout | None = None
        _WITH_THREADS.add(self)

    def __reduce__(self) -> tuple[Any, ...]:
        # Threads cannot be copied, and every step starts afresh: a new one of the same model goes on in the same way.
        return partial(MujocoPhysics, threads=self._threads), (self.model,)

    def __call__(self, state: Tensor, control: Tensor) -> Tensor:
        """States after the last substep; see :class:`Physics`."""
        if self._rollout is None:
            self._rollout = self._make_rollout()
        start = np.concatenate([np.zeros((len(state), 1)), state.cpu().numpy()], axis=1)
        reached, _ = self._rollout.rollout(
            self.model, self._data, start, control.cpu().numpy(), control_spec=int(mujoco.mjtState.mjSTATE_CTRL)
        )
        return torch.from_numpy(reached[:, -1, 1:].copy()).to(state.device)


class WarpPhysics:
    """MuJoCo Warp: all worlds in one kernel launch. Made for GPUs; on a CPU it is slow and serves tests alone.

    It computes in float32, so it follows C MuJoCo closely but not to the bit.

    Args:
        model: compiled; see MuJoCo Warp's documentation for what it does not support.
        num_envs: N.
        device: of PyTorch, whose counterpart Warp computes on.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, device: torch.device) -> None:
        from ls3_envs.mujoco._warp import mjw, wp, wp_device

        self.model, self._wp = model, wp
        self._device = wp_device(device)
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(model)
            # Room for the contacts of every world, not only for those of the first pose.
            self._data = mjw.put_data(model, mujoco.MjData(model), nworld=num_envs, nconmax=64, njmax=256)
        self._step = mjw.step
        self._arguments = (model, num_envs, device)

    def __reduce__(self) -> tuple[Any, ...]:
        return WarpPhysics, self._arguments

    def __call__(self, state: Tensor, control: Tensor) -> Tensor:
        """States after the last substep; see :class:`Physics`."""
        wp, data = self._wp, self._data
        qpos, qvel = (wp.to_torch(array) for array in (data.qpos, data.qvel))
        with wp.ScopedDevice(self._device):
            qpos.copy_(state[:, : self.model.nq])
            qvel.copy_(state[:, self.model.nq :])
            wp.to_torch(data.qacc_warmstart).zero_()
            for controls in control.unbind(1):
                wp.to_torch(data.ctrl).copy_(controls)
                self._step(self._model, data)
        return torch.cat([qpos, qvel], dim=1).to(state)


def make_physics(
    name: str, model: mujoco.MjModel, *, num_envs: int, device: torch.device, threads: int | None
) -> Physics:
    """The back end ``"mujoco"`` or ``"warp"``.

    Raises:
        ValueError: for another name.
    """
    if name == "mujoco":
        return MujocoPhysics(model, threads=threads)
    if name == "warp":
        return WarpPhysics(model, num_envs, device)
    raise ValueError(f"physics must be one of {', '.join(map(repr, PHYSICS))}, got {name!r}.")
