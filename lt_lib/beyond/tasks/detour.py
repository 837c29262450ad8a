"""Through the mat or round it: the better one depends on the depth and on what the detour costs this very receiver.

The reward is minus the cost, in metres of mat. The receiver knows its own detour and the sender does not, so no single
bit serves all receivers: the more finely the depth is told, the smaller the regret.
"""

import numpy as np
from jaxtyping import Float

from lt_lib.beyond.rich import RichScenes
from lt_lib.beyond.tasks.depth import classes
from lt_lib.beyond.tasks.task import Task, binary


def reward(scenes: RichScenes) -> Float[np.ndarray, "n a"]:
    return -np.column_stack([scenes.depth, scenes.detour])


TASK = Task(
    "through or round",
    reward,
    bits=lambda scenes: binary(classes(scenes, 2), 1),
    own=lambda scenes: scenes.detour[:, None],
)
