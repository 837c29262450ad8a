"""Set before any test module is imported: checked array shapes, and a renderer that needs no screen."""

import os

import jaxtyping

if "DISPLAY" not in os.environ:
    os.environ.setdefault("MUJOCO_GL", "egl")

jaxtyping.install_import_hook("lt_lib", "beartype.beartype")
