"""Instruments of notebook 10: calls timed in turns, the profile of one call."""

import contextlib
import cProfile
import pstats
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch


@contextlib.contextmanager
def single_threaded_torch() -> Iterator[None]:
    """Restricts torch to one thread inside the block, as in a worker of the run store."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def taking_turns(
    calls: Mapping[str, Callable[[], Any]], rounds: int, clock: Callable[[], float] = time.process_time
) -> dict[str, float]:
    """Seconds per call: the median over rounds in which all calls take turns, after one warm-up round.

    Taking turns spreads whatever slows the machine over all calls alike. Torch has one thread, because further threads
    add processor time even while they wait.

    clock  the default counts the processor time of this process alone; `time.perf_counter` includes the work of others
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    with single_threaded_torch():
        for turn in range(rounds + 1):
            for name, call in calls.items():
                start = clock()
                call()
                if turn:
                    seconds[name].append(clock() - start)
    return {name: float(np.median(values)) for name, values in seconds.items()}


def profile_call(call: Callable[[], Any], most: int) -> pd.DataFrame:
    """The `most` functions in which a call spends most time, excluding what they call: seconds, calls and share."""
    profiler = cProfile.Profile()
    with single_threaded_torch():
        profiler.runcall(call)
    rows = {
        f"{Path(file).name}:{name}" if "~" not in file else name: {"seconds": own, "calls": calls}
        for (file, _, name), (_, calls, own, _, _) in pstats.Stats(profiler).stats.items()
    }
    table = pd.DataFrame(rows).T.sort_values("seconds", ascending=False)
    return table.assign(share=table.seconds / table.seconds.sum()).head(most)
