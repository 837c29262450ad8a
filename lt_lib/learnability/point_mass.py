"""The point-mass task (Section 'A scalar predictor of learnability'): nothing in common with our scene but its logic.

A point mass runs along a corridor at constant speed while it is commanded sideways. After N control steps it is on the
alternative side if the mean of its N lateral commands was at least d, and on the incumbent side otherwise. One of the
two sides is safe. Lengths are in full-command steps, so that a mean command of d means d * N sideways.
"""

import numpy as np
from jaxtyping import Bool, Float


def enters_alternative(mean_command: Float[np.ndarray, "*e"], d: Float[np.ndarray, "*#e"]) -> Bool[np.ndarray, "*e"]:
    """Whether windows with these mean lateral commands end on the alternative side."""
    return mean_command >= d


def reward(entered: Bool[np.ndarray, "*e"], safe: Bool[np.ndarray, "*e"]) -> Float[np.ndarray, "*e"]:
    """1 for ending on the safe side, 0 for the other; `safe` is whether the alternative side is the safe one."""
    return (entered == safe).astype(float)


def positions(commands: Float[np.ndarray, "*e n"]) -> Float[np.ndarray, "*e n+1 2"]:
    """The way through the corridor: (steps along it, steps sideways), from the start on."""
    sideways = np.concatenate([np.zeros_like(commands[..., :1]), commands.cumsum(-1)], axis=-1)
    along = np.broadcast_to(np.arange(sideways.shape[-1], dtype=sideways.dtype), sideways.shape)
    return np.stack([along, sideways], axis=-1)
