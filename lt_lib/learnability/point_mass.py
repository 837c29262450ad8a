"""The point-mass task (Section 'A scalar predictor of learnability'), which shares only its logic with our scene.

A point mass moves along a corridor at constant speed under lateral commands. After N control steps it is on the
alternative side if the mean of its N commands was at least d, otherwise on the incumbent side. One of the two sides is
safe. Lengths are in full-command steps, so a mean command of d moves it d * N sideways.
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
    """The path through the corridor, including the start: (steps along, steps sideways)."""
    sideways = np.concatenate([np.zeros_like(commands[..., :1]), commands.cumsum(-1)], axis=-1)
    along = np.broadcast_to(np.arange(sideways.shape[-1], dtype=sideways.dtype), sideways.shape)
    return np.stack([along, sideways], axis=-1)
