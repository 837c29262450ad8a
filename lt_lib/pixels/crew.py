"""Controllers that do as told: of a few trainings, the weights whose mean command most often gets where it is sent.

A controller that explores may reach the goal, or the slab of a blocked corridor, long before its mean does, and the
mean may lose the way again, in one corridor and not in the other. So weights are kept along the second half of a
training, each drives a few draws that no bank has, and where even the best seldom get there, another seed is trained.
No message plays a part in this.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lt_lib.envs.layout import load_layout
from lt_lib.pixels.episodes import arrival, roll_bank, slab_reached
from lt_lib.pixels.executor import train_executor
from lt_lib.settings.pixels import ExecutorConfig, PixelsConfig
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore
from lt_lib.store.states import after, only

PARTS = 4  # that the second half of a training is divided into, the weights kept at each end
TRIED, TRIAL = 4, 1_000  # draws that each of them drives, as many as a shard at most; their seed, which no shard has
SEEDS, ENOUGH = 3, 0.95  # trainings at most; shares of arrivals, and of slabs reached, that end the search


def with_looks(executor: ExecutorConfig) -> ExecutorConfig:
    """The training with weights kept along its second half, after whole updates."""
    update = executor.envs * executor.rollout
    looks = {max(1, executor.steps * part // (2 * PARTS) // update) * update for part in range(PARTS, 2 * PARTS + 1)}
    return executor.model_copy(update={"steps": max(executor.steps, *looks), "looks": tuple(sorted(looks))})


def arriving_executors(
    store: RunStore, sizes: Mapping[Any, PixelsConfig], encoders: Mapping[Any, Result]
) -> dict[Any, Result]:
    """One executor per size, behind its encoder: its weights, "curve.*" of its training and "taken", their steps."""
    best: dict[Any, tuple[float, Result]] = {}
    for seed in range(SEEDS):
        missing = {key: each for key, each in sizes.items() if key not in best or best[key][0] < ENOUGH}
        for key, found in _tried(store, missing, encoders, seed).items():
            best[key] = max(found, best.get(key, found), key=lambda each: each[0])
    return {key: best[key][1] for key in sizes}


def _tried(
    store: RunStore, sizes: Mapping[Any, PixelsConfig], encoders: Mapping[Any, Result], seed: int
) -> dict[Any, tuple[float, Result]]:
    """Of one training each, how often its best weights get there, free or blocked, and the weights."""
    training = {key: with_looks(each.executor) for key, each in sizes.items()}
    lone = len(sizes) == 1 and seed % 2 == 0  # the next seed trains beside it, on an idle core
    seeds = range(seed, min(seed + 1 + lone, SEEDS))
    runs = [Run(train_executor, training[key], each, {"encoder": encoders[key]}) for each in seeds for key in sizes]
    trained = dict(zip(sizes, store.fetch(runs, "executors")[: len(sizes)], strict=True))
    kept = {(key, look): after(trained[key], look) for key in sizes for look in training[key].looks}
    few = {key: each.bank.model_copy(update={"entries": min(TRIED, each.bank.entries)}) for key, each in sizes.items()}
    drives = [
        Run(roll_bank, few[key], TRIAL, {"encoder": encoders[key], "executor": weights})
        for (key, _), weights in kept.items()
    ]
    tried: dict[Any, list[tuple[float, Result]]] = {key: [] for key in sizes}
    for ((key, look), weights), driven in zip(kept.items(), store.fetch(drives, "trials"), strict=True):
        whole = weights | only(trained[key], "curve") | {"taken": np.array(look)}
        blocks = load_layout(few[key].layout).blocks
        tried[key].append((min(arrival(driven, blocks), slab_reached(driven, blocks)), whole))
    return {key: max(each, key=lambda one: one[0]) for key, each in tried.items()}
