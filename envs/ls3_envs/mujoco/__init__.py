"""What the MuJoCo domains share: physics of many worlds at once, pictures without a display, and their environment."""

from ls3_envs.mujoco.env import MujocoEnv
from ls3_envs.mujoco.physics import PHYSICS, MujocoPhysics, Physics, WarpPhysics, make_physics
from ls3_envs.mujoco.rendering import RENDERERS, EGLRenderer, RayTracer, Renderer, View, make_renderer

__all__ = [
    "PHYSICS",
    "RENDERERS",
    "EGLRenderer",
    "MujocoEnv",
    "MujocoPhysics",
    "Physics",
    "RayTracer",
    "Renderer",
    "View",
    "WarpPhysics",
    "make_physics",
    "make_renderer",
]
