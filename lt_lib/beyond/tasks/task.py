"""What a decision consists of."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lt_lib.beyond.rich import RichScenes


def nothing(scenes: RichScenes) -> Float[np.ndarray, "n 0"]:
    """What a receiver knows that has only its message."""
    return np.empty((len(scenes.slab), 0))


class Task(NamedTuple):
    """A decision of one receiver.

    reward  of each of its actions in n scenes, (n, actions)
    bits    the message that a designer who knows the task would write, (n, k) of 0 and 1
    own     what the receiver knows by itself, (n, j)
    """

    words: str
    reward: Callable[[RichScenes], Float[np.ndarray, "n a"]]
    bits: Callable[[RichScenes], Float[np.ndarray, "n k"]]
    own: Callable[[RichScenes], Float[np.ndarray, "n j"]] = nothing


def chosen(right: np.ndarray, actions: int) -> Float[np.ndarray, "n a"]:
    """Reward 1 for the right one of so many actions, 0 for the others."""
    return np.eye(actions)[right]


def binary(values: np.ndarray, bits: int) -> Float[np.ndarray, "n k"]:
    """Whole numbers in binary."""
    return (values[:, None] >> np.arange(bits) & 1).astype(float)
