"""Random streams, named by purpose, condition and seed: runs share random numbers only where they share all three."""

from enum import IntEnum, unique
from zlib import crc32

import numpy as np


@unique
class Stream(IntEnum):
    """What random numbers are for. A number never changes once used, since another one gives another result."""

    ENCODER = 0
    EXECUTOR = 1
    BANK = 2
    HEAD = 3  # on the bank and live: the same draws of the scene, so that both can be compared episode by episode
    CORRUPTION = 4
    GATES = 5
    NAVIGATOR = 6
    ROLLOUT = 7
    GRID_POLICY = 8
    GRID_EVALUATION = 9
    FILM = 10
    SWEEP = 11
    SIMULATED_BENCH = 12
    RAILS = 13
    PATCH_ENCODER = 14
    MATCHED_ENCODER = 15
    MATCHED_GATES = 16
    SENDER = 17  # a sender's training, beyond the frames it shares with the encoder's
    LADDER = 18  # scenes of a rung
    READER = 19  # a head that reads a sender on a rung
    SENDER_GATES = 20
    LAYOUTS = 21
    RADIO = 22  # scenes whose messages travel by radio, and what becomes of them on the way
    CROWD = 23  # scenes with many senders
    LOOP = 24  # episodes behind the surrogate camera

    def generator(self, seed: int, *condition: str) -> np.random.Generator:
        """The generator of this stream for a seed, and for a condition where several are compared."""
        return np.random.default_rng([seed, self.value, *(crc32(name.encode()) for name in condition)])
