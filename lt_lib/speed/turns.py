"""Timing calls against each other on a machine that has other things to do."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Gives torch one thread in the block, as it has in a run's worker."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def taking_turns(
    calls: Mapping[str, Callable[[], Any]], rounds: int, clock: Callable[[], float] = time.process_time
) -> dict[str, float]:
    """Seconds of each call, the median over rounds in which all take turns, after one round that warms up.

    In turns, so that whatever slows the machine slows all alike; with one thread, since others also count while they
    wait. The default clock counts the processor time of this process; `time.perf_counter` also sees what other
    processes do for it.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    with one_thread():
        for turn in range(rounds + 1):
            for name, call in calls.items():
                start = clock()
                call()
                if turn:
                    seconds[name].append(clock() - start)
    return {name: float(np.median(values)) for name, values in seconds.items()}
