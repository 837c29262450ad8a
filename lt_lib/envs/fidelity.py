"""How well the fast camera agrees with `mujoco.Renderer` (Section Setup's camera)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lt_lib.envs.camera import FastCamera, colours
from lt_lib.envs.materials import HAZARD
from lt_lib.envs.reference import ReferenceCamera


class Agreement(NamedTuple):
    """Over a set of poses."""

    pixels: float  # share of pixels whose material and face are MuJoCo's
    flags: float  # share of frames on whose hazard-visible flag both agree
    grey_levels: int  # largest difference of a colour from MuJoCo's picture, of 255, over the agreeing pixels
    frames: int


def agreement(
    fast: FastCamera,
    reference: ReferenceCamera,
    eyes: Float[np.ndarray, "b 3"],
    slabs,
    others: Float[np.ndarray, "b 2"],
) -> Agreement:
    """Compares with MuJoCo's segmentation and with its colours; arguments as for `FastCamera.frames`."""
    ours, theirs = (camera.frames(eyes, slabs, others) for camera in (fast, reference))
    same = ours == theirs
    flags = HAZARD[ours].any(axis=(1, 2)) == HAZARD[theirs].any(axis=(1, 2))
    apart = np.abs(colours(ours).astype(int) - reference.pictures(eyes, slabs, others))
    return Agreement(float(same.mean()), float(flags.mean()), int(apart[same].max()), len(eyes))
