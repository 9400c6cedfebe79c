"""Pictures of many worlds behind one call: a ray tracer that needs no OpenGL, and OpenGL through EGL."""

from __future__ import annotations

import os
from functools import partial
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np
import torch
from torch import Tensor

RENDERERS = ("raytrace", "egl")


class View(NamedTuple):
    """What a camera sees of n worlds.

    Attributes:
        pixels: uint8 ``[n, 3, S, S]``.
        geoms: number of the geom behind each pixel, int64 ``[n, S, S]``, −1 for none.
    """

    pixels: Tensor
    geoms: Tensor


class Renderer(Protocol):
    """Renders any poses; what a world looks like depends on its own pose alone."""

    def __call__(self, qpos: Tensor) -> View:
        """The view of poses ``[n, nq]``."""


def check_camera(model: mujoco.MjModel, camera: str, size: int) -> int:
    """Number of the camera; ``ValueError`` for an unknown one or an image without pixels."""
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
    if number < 0:
        known = [model.camera(i).name for i in range(model.ncam)]
        raise ValueError(f"The model has no camera {camera!r}; it has: {', '.join(known)}.")
    if not 8 <= size <= 1024:
        raise ValueError(f"image_size must lie in 8..1024 pixels, got {size}.")
    return number


class RayTracer:
    """MuJoCo Warp's ray tracer: no OpenGL and no display, on the CPU or a GPU, many worlds in one call.

    The first picture on a machine compiles kernels for some seconds; later processes find them on disk.

    Args:
        model: compiled.
        camera: name of the camera.
        size: side of the image in pixels, 8 to 1024.
        num_envs: worlds rendered in one call; other numbers are rendered in several.
        device: of PyTorch, whose counterpart Warp renders on.
        groups: geom groups that are seen.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: str,
        *,
        size: int = 64,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        groups: tuple[int, ...] = (0, 1, 2),
    ) -> None:
        from ls3_envs.mujoco._warp import mjw, wp, wp_device

        number = check_camera(model, camera, size)
        self.size, self.num_envs = size, num_envs
        self._mjw, self._wp, self._device = mjw, wp, wp_device(torch.device(device))
        self._copy = (
            partial(RayTracer, camera=camera, size=size, num_envs=num_envs, device=device, groups=groups),
            model,
        )
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)  # a fixed camera has its pose only after it
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(model)
            self._data = mjw.put_data(model, data, nworld=num_envs)
            self._context = mjw.create_render_context(
                model,
                nworld=num_envs,
                cam_res=(size, size),
                render_rgb=True,
                render_depth=False,
                render_seg=True,
                cam_active=[i == number for i in range(model.ncam)],
                use_textures=False,
                enabled_geom_groups=list(groups),
                enable_specular=False,
                enable_emission=False,
                enable_per_light_ambient=False,
            )

    def __reduce__(self) -> tuple[Any, ...]:
        # Nothing is kept from one picture to the next: one made anew draws the same.
        make, model = self._copy
        return make, (model,)

    def __call__(self, qpos: Tensor) -> View:
        """The view of poses ``[n, nq]``."""
        n, worlds = len(qpos), self.num_envs
        if n == worlds:
            return self._render(qpos)
        missing = -n % worlds
        padded = torch.cat([qpos, qpos[-1:].expand(missing, -1)])
        views = [self._render(part) for part in padded.split(worlds)]
        return View(*(torch.cat(parts)[:n] for parts in zip(*views, strict=True)))

    def _render(self, qpos: Tensor) -> View:
        wp, mjw = self._wp, self._mjw
        with wp.ScopedDevice(self._device):
            wp.to_torch(self._data.qpos).copy_(qpos)
            mjw.kinematics(self._model, self._data)
            mjw.camlight(self._model, self._data)
            mjw.refit_bvh(self._model, self._data, self._context)
            mjw.render(self._model, self._data, self._context)
            packed = wp.to_torch(self._context.rgb_data).view(torch.uint8)
            seen = wp.to_torch(self._context.seg_data)
        shape = (self.num_envs, self.size, self.size)
        bgra = packed.reshape(*shape, 4)
        geoms = seen.reshape(*shape, -1)[..., 0].long()
        return View(bgra[..., [2, 1, 0]].permute(0, 3, 1, 2).contiguous(), geoms)


class EGLRenderer:
    """OpenGL without a window, for machines that have EGL: twice as fast where there is a GPU driver for it.

    Args:
        model: compiled.
        camera: name of the camera.
        size: side of the image in pixels, 8 to 1024.
        groups: geom groups that are seen.

    Raises:
        RuntimeError: when EGL was not chosen before MuJoCo was imported, or does not work here.
    """

    def __init__(
        self, model: mujoco.MjModel, camera: str, *, size: int = 64, groups: tuple[int, ...] = (0, 1, 2)
    ) -> None:
        check_camera(model, camera, size)
        remedy = 'Or use renderer="raytrace", which needs no OpenGL.'
        if os.environ.get("MUJOCO_GL", "").lower() != "egl":
            raise RuntimeError(
                'renderer="egl" needs the environment variable MUJOCO_GL=egl, set before the first import of mujoco; '
                f"it is {os.environ.get('MUJOCO_GL')!r}. {remedy}"
            )
        model.vis.quality.offsamples = 0  # blended edges would blur which pixel shows what
        try:
            self._renderer = mujoco.Renderer(model, size, size)
        except Exception as error:
            raise RuntimeError(f"EGL does not work on this machine: {error}. {remedy}") from error
        self._model, self._data, self._camera = model, mujoco.MjData(model), camera
        self._copy = partial(EGLRenderer, camera=camera, size=size, groups=groups), model
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = [group in groups for group in range(6)]

    def __reduce__(self) -> tuple[Any, ...]:
        make, model = self._copy
        return make, (model,)

    def __call__(self, qpos: Tensor) -> View:
        """The view of poses ``[n, nq]``."""
        views = [self._render(pose) for pose in qpos.double().cpu().numpy()]
        pixels, geoms = (torch.from_numpy(np.stack(parts)).to(qpos.device) for parts in zip(*views, strict=True))
        return View(pixels.permute(0, 3, 1, 2).contiguous(), geoms.long())

    def _render(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        renderer = self._renderer
        self._data.qpos[:] = pose
        mujoco.mj_forward(self._model, self._data)
        renderer.update_scene(self._data, self._camera, self._options)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            renderer.scene.flags[flag] = False
        pixels = renderer.render().copy()
        renderer.enable_segmentation_rendering()
        ids, kinds = np.moveaxis(renderer.render(), -1, 0)
        renderer.disable_segmentation_rendering()
        return pixels, np.where(kinds == mujoco.mjtObj.mjOBJ_GEOM, ids, -1)

    def close(self) -> None:
        """Give the OpenGL context back."""
        self._renderer.close()


def make_renderer(
    name: str,
    model: mujoco.MjModel,
    camera: str,
    *,
    size: int,
    num_envs: int,
    device: torch.device,
    groups: tuple[int, ...] = (0, 1, 2),
) -> Renderer:
    """The renderer ``"raytrace"`` or ``"egl"``.

    Raises:
        ValueError: for another name, an unknown camera or size.
        RuntimeError: when EGL is asked for where it does not work.
    """
    if name == "raytrace":
        return RayTracer(model, camera, size=size, num_envs=num_envs, device=device, groups=groups)
    if name == "egl":
        return EGLRenderer(model, camera, size=size, groups=groups)
    raise ValueError(f"renderer must be one of {', '.join(map(repr, RENDERERS))}, got {name!r}.")
