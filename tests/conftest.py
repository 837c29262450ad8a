"""Set before any test module is imported: checked array shapes, and a renderer that needs no screen."""

import os

import jaxtyping
import torch

if "DISPLAY" not in os.environ:
    os.environ.setdefault("MUJOCO_GL", "egl")

torch.set_num_threads(1)  # as in a run's worker; two would fight over the cores

import lt_lib.envs.raycast  # compiled code, imported before the checks so that they leave it alone
import lt_lib.learners.grid_walks
import lt_lib.learners.table_ppo
import lt_lib.perception.recolour  # noqa: F401

jaxtyping.install_import_hook("lt_lib", "beartype.beartype")
