"""How well the fast camera agrees with `mujoco.Renderer` (Section Setup)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lt_lib.envs.camera import FastCamera, colours
from lt_lib.envs.materials import HAZARD
from lt_lib.envs.reference import ReferenceCamera


class Agreement(NamedTuple):
    """How two cameras agree over a set of poses."""

    pixels: float  # share of pixels with MuJoCo's material and face
    flags: float  # share of frames with MuJoCo's hazard-visible flag
    grey_levels: int  # largest colour difference from MuJoCo's picture, out of 255, over the agreeing pixels
    frames: int


def agreement(
    fast: FastCamera,
    reference: ReferenceCamera,
    eyes: Float[np.ndarray, "b 3"],
    slabs,
    others: Float[np.ndarray, "b 2"],
) -> Agreement:
    """Compares the fast camera with MuJoCo's segmentation and colours; arguments as for `FastCamera.frames`."""
    ours, theirs = (camera.frames(eyes, slabs, others) for camera in (fast, reference))  # (B, H, W)
    same = ours == theirs
    flags = HAZARD[ours].any(axis=(1, 2)) == HAZARD[theirs].any(axis=(1, 2))  # (B,)
    apart = np.abs(colours(ours).astype(int) - reference.pictures(eyes, slabs, others))  # (B, H, W, 3)
    return Agreement(float(same.mean()), float(flags.mean()), int(apart[same].max()), len(eyes))
