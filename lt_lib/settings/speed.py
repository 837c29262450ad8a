"""Settings of the timings in notebook 10."""

from typing import Annotated

from pydantic import Field, PositiveInt

from lt_lib.settings.base import Settings
from lt_lib.settings.learnability import Budget

Sizes = Annotated[tuple[PositiveInt, ...], Field(min_length=3)]  # from the smallest to the largest


class Stretch(Settings):
    """How much of the real work notebook 10 times, and at which sizes."""

    rounds: PositiveInt  # in each, all sides take turns
    scenes: PositiveInt  # draws of the scene, at either precision
    live: PositiveInt  # episodes
    navigator: PositiveInt  # control steps of a navigator's training, profiled
    frames: PositiveInt  # of a matched encoder's training, profiled
    singles: PositiveInt  # runs of a stack timed one by one
    runs: PositiveInt  # shared among workers
    updates: Budget  # of the point-mass study
    environments: Sizes
    seeds: Sizes
    episodes: Sizes
