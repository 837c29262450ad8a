"""What one control step costs, stage by stage, with the fast camera and with `mujoco.Renderer`, side by side."""

import numpy as np
import pandas as pd

from lt_lib.envs.arena import Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import Layout
from lt_lib.envs.reference import ReferenceCamera
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.pixels.episodes import draw_scenes
from lt_lib.pixels.executor import FrozenExecutor
from lt_lib.speed.turns import taking_turns
from lt_lib.store.run import Result

ENVS = 64  # scenes stepped side by side, as in training


def step_costs(layout: Layout, encoder: Result, executor: Result, rounds: int = 7) -> pd.DataFrame:
    """Microseconds of processor time a scene and control step: the median over rounds in which all stages take turns.

    Processor time counts every thread, so these are the costs on one core. Columns: with either camera.
    """
    arena, frozen, driver = Arena(layout, ENVS), FrozenEncoder(encoder), FrozenExecutor(executor)
    fast, reference, rng = FastCamera(layout), ReferenceCamera(layout), np.random.default_rng(0)
    draws, route = draw_scenes(layout, ENVS, rng), rng.integers(0, 2, ENVS)
    arena.reset(np.ones(ENVS, bool), draws.spawn, rng.integers(0, 2, ENVS), draws.scout)
    frames = fast.frames(arena.pose, arena.slab, arena.scout[:, :2])
    latent = frozen.latent(frames)
    action = driver.mean_action(latent, route)
    stages = {
        "camera": lambda: fast.frames(arena.pose, arena.slab, arena.scout[:, :2]),
        "mujoco.Renderer": lambda: reference.pictures(arena.pose, arena.slab, arena.scout[:, :2]),
        "encoder": lambda: frozen.latent(frames),
        "policy": lambda: driver.mean_action(latent, route),
        "physics": lambda: arena.step(action),
    }
    cost = {stage: seconds / ENVS * 1e6 for stage, seconds in taking_turns(stages, rounds).items()}
    reference.close()
    shared = {stage: cost[stage] for stage in ("physics", "encoder", "policy")}
    table = pd.DataFrame({
        "fast camera": {"camera": cost["camera"], **shared},
        "mujoco.Renderer": {"camera": cost["mujoco.Renderer"], **shared},
    })  # fmt: skip
    table.loc["whole step"] = table.sum()
    return table
