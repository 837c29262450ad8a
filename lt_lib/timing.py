"""Timing calls against each other on a machine that has other things to do."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np


def taking_turns(
    calls: Mapping[str, Callable[[], Any]], rounds: int, clock: Callable[[], float] = time.process_time
) -> dict[str, float]:
    """Seconds of each call, the median over rounds in which all take turns, after one round that warms up.

    In turns, so that whatever slows the machine slows all alike. The default clock counts the processor time of this
    process and all its threads, the cost on one core; `time.perf_counter` also sees what other processes do for it.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds + 1):
        for name, call in calls.items():
            start = clock()
            call()
            if turn:
                seconds[name].append(clock() - start)
    return {name: float(np.median(values)) for name, values in seconds.items()}
