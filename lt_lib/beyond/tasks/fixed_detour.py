"""Through the mat or round it by a detour whose cost is one and the same for all: the better one depends on the depth.

The reward is minus the cost, in metres of mat.
"""

import numpy as np
from jaxtyping import Float

from lt_lib.beyond.rich import RichScenes
from lt_lib.beyond.tasks.task import Task, binary

COST = 0.6  # metres of mat that the detour is worth


def reward(scenes: RichScenes) -> Float[np.ndarray, "n a"]:
    return -np.column_stack([scenes.depth, np.full(len(scenes.depth), COST)])


TASK = Task("through or round at 0.6 m", reward, bits=lambda scenes: binary((scenes.depth > COST).astype(int), 1))
