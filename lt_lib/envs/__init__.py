"""The scene: one layout, its physics, its cameras (Section Setup)."""

import os
import sys

# MuJoCo chooses its OpenGL when it is first imported, so this must come before anything that imports it.
if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")
