"""A trial of an executor: a few draws under every placement and route, as its pretraining rewards it (obedience)."""

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


def try_executor(
    config: BankConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    encoder: Mapping[str, np.ndarray],
    executor: Mapping[str, np.ndarray],
) -> dict:
    """Whether the mean command does as told, (entries, pairs of a placement and a route each).

    "arrives"  on free routes: it reaches the goal
    "touches"  on blocked ones: it enters the corridor and reaches a slab
    """
    layout, device = load_layout(config.layout), config.device
    draws = draw_scenes(layout, config.entries, Stream.BANK.generator(seed))
    shape = (config.entries, len(layout.placements), len(layout.routes))
    entry, slab, route = (axis.ravel() for axis in np.indices(shape))
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
    arrives = outcome.success.reshape(shape)
    touches = ((outcome.entered == route) & (outcome.contacts > 0)).reshape(shape)
    return {"arrives": arrives[:, ~layout.blocks], "touches": touches[:, layout.blocks]}
