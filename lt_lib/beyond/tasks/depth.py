"""How deep the mat is: one of four classes; a neighbouring class is worth two thirds, the farthest nothing."""

import numpy as np
from jaxtyping import Float, Int

from lt_lib.beyond.rich import DEPTHS, RichScenes
from lt_lib.beyond.tasks.task import Task, binary

CLASSES = 4


def classes(scenes: RichScenes, number: int = CLASSES) -> Int[np.ndarray, " n"]:
    """The class of each depth, of equal widths."""
    low, high = DEPTHS
    return np.minimum(((scenes.depth - low) / (high - low) * number).astype(int), number - 1)


def reward(scenes: RichScenes) -> Float[np.ndarray, "n a"]:
    return 1 - np.abs(np.arange(CLASSES) - classes(scenes)[:, None]) / (CLASSES - 1)


TASK = Task("how deep", reward, bits=lambda scenes: binary(classes(scenes), 2))
