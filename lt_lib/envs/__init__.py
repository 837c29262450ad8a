"""The scene: one layout, its physics and its cameras (Section Setup)."""

import os

# MuJoCo loads OpenGL on its first import, although only rendering needs it; `envs.opengl` opens it for that.
_named = os.environ.get("MUJOCO_GL")
os.environ["MUJOCO_GL"] = "disable"
import mujoco  # noqa: F401

if _named is None:
    del os.environ["MUJOCO_GL"]
else:
    os.environ["MUJOCO_GL"] = _named
