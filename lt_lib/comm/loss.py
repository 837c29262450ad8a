"""Which packets a radio link loses: single ones, or several in a row (Gilbert and Elliott's two states)."""

import numpy as np
from jaxtyping import Bool, Int


class GilbertElliott:
    """Links that alternate between a good state, in which no packet is lost, and a bad one, in which all are.

    links   shape of the links, those of a channel's senders
    rate    share of packets lost in the long run, [0, 1)
    memory  correlation of a packet's fate with that of the one before, [0, 1); 0 loses each packet independently. The
            bad state lasts 1 / ((1 - rate) (1 - memory)) packets in the mean.
    """

    def __init__(self, links: tuple[int, ...], rate: float, memory: float, rng: np.random.Generator):
        if not (0 <= rate < 1 and 0 <= memory < 1):
            raise ValueError(f"loss: rate and memory must lie in [0, 1), got {rate} and {memory}")
        self._links, self._rate, self._memory, self._rng = links, rate, memory, rng
        self._bad = rng.random(links) < rate

    def __call__(self, rows: Int[np.ndarray, " b"]) -> Bool[np.ndarray, "b ..."]:
        """Whether the next packet of each of these rows' links is lost."""
        lost = self._bad[rows]
        stays = self._memory + (1 - self._memory) * self._rate  # bad after bad
        falls = (1 - self._memory) * self._rate  # bad after good
        self._bad[rows] = self._rng.random(lost.shape) < np.where(lost, stays, falls)
        return lost
