"""A trial of an executor: some draws on the free routes alone, where it should arrive."""

from collections.abc import Callable, Mapping

import numpy as np

from lt_lib.envs.arena import HORIZON, Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import load_layout
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.pixels.episodes import draw_scenes, drive
from lt_lib.pixels.executor import FrozenExecutor
from lt_lib.settings.pixels import BankConfig
from lt_lib.settings.streams import Stream


def drive_free_routes(
    config: BankConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    encoder: Mapping[str, np.ndarray],
    executor: Mapping[str, np.ndarray],
) -> dict:
    """Whether the mean command arrives: "arrived" (entries, free) on every free route under every placement."""
    layout, device = load_layout(config.layout), config.device
    draws = draw_scenes(layout, config.entries, Stream.BANK.generator(seed))
    slab, route = np.nonzero(~layout.blocks)
    entry = np.repeat(np.arange(config.entries), len(slab))
    slab, route = (np.tile(each, config.entries) for each in (slab, route))
    outcome = drive(
        Arena(layout, min(config.envs, len(entry))),
        FastCamera(layout),
        FrozenEncoder(encoder, device, config.precision),
        FrozenExecutor(executor, device),
        draws.of(entry),
        slab,
        route,
        config.commit_step,
        HORIZON,
        report,
    )
    return {"arrived": outcome.success.reshape(config.entries, -1)}
