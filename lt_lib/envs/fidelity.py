"""How well the fast camera agrees with `mujoco.Renderer`, and how much faster it is (Section Setup's camera)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lt_lib.envs.camera import FastCamera, colours, network_input
from lt_lib.envs.materials import HAZARD
from lt_lib.envs.reference import ReferenceCamera
from lt_lib.timing import taking_turns

BATCH, SLOW_BATCH = 256, 32  # frames a turn: what a training asks for at a time, and fewer of the slow ones


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


def frame_rates(
    fast: FastCamera,
    reference: ReferenceCamera,
    eyes: Float[np.ndarray, "b 3"],
    slabs,
    others: Float[np.ndarray, "b 2"],
    rounds: int = 5,
) -> dict[str, float]:
    """Frames a second of processor time, the median over rounds in which the cameras take turns.

    Processor time counts all threads of this process, so these are the rates of one core; a renderer on a GPU
    would hide its work from it.
    """
    scenes = [values[np.arange(BATCH) % len(eyes)] for values in (eyes, np.asarray(slabs), others)]
    few = [values[:SLOW_BATCH] for values in scenes]
    draws = {
        "mujoco.Renderer": (SLOW_BATCH, lambda: reference.pictures(*few)),
        "fast camera": (BATCH, lambda: fast.frames(*scenes)),
        "fast camera, expanded to the network's input": (BATCH, lambda: network_input(fast.frames(*scenes))),
    }
    seconds = taking_turns({name: draw for name, (_, draw) in draws.items()}, rounds)
    return {name: frames / seconds[name] for name, (frames, _) in draws.items()}
