"""Makes MuJoCo importable whatever ``MUJOCO_GL`` says: pictures are ray-traced here and need no OpenGL.

MuJoCo loads the OpenGL library that the variable names while it is imported, and where that fails, nothing of MuJoCo
can be used. TorchRL imports MuJoCo wherever it is installed, so that even domains without it would fail. Hence this
module is the first that the package imports.
"""

from __future__ import annotations

import os
import sys
import warnings


def import_mujoco() -> None:
    """Import MuJoCo if it is installed, without OpenGL where ``MUJOCO_GL`` names what does not work."""
    chosen = os.environ.get("MUJOCO_GL")
    if chosen is None or "mujoco" in sys.modules:
        return
    try:
        import mujoco
    except ImportError:  # not installed, which is said where a domain needs it
        return
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
    else:
        return
    # Only mujoco.Renderer, which no domain uses unless it is asked for EGL, is missing after an import without OpenGL.
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco  # noqa: F401
    finally:
        os.environ["MUJOCO_GL"] = chosen
    warnings.warn(
        f"The environment variable MUJOCO_GL={chosen!r} does not work on this machine ({reason}). MuJoCo was imported "
        "without OpenGL, which ls3_envs does not need. Unset MUJOCO_GL, or set it to 'disable'.",
        stacklevel=3,
    )


import_mujoco()
