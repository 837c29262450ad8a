"""The scene: one layout, its physics, its cameras (Section Setup)."""

import os

# MuJoCo loads OpenGL when it is first imported, though only pictures need it: `envs.opengl` opens it for those.
_named = os.environ.get("MUJOCO_GL")
os.environ["MUJOCO_GL"] = "disable"
import mujoco  # noqa: F401

if _named is None:
    del os.environ["MUJOCO_GL"]
else:
    os.environ["MUJOCO_GL"] = _named
