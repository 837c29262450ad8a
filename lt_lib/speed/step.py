"""The cost of one control step: frame, latent, velocity, physics."""

from collections.abc import Callable

import mujoco
import numpy as np
import pandas as pd
from jaxtyping import Float
from mujoco.batch import Batch

from lt_lib.comm.messages import CONTENTS, Sender
from lt_lib.envs.arena import CONTROL_HZ, PHYSICS_HZ, Arena, physics_xml
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
    """Microseconds of processor time per scene and control step, by stage: ours, and MuJoCo's camera and physics.

    Each number is the median over rounds in which all stages take turns. Processor time includes every thread, so these
    are costs on one core.
    """
    arena, route = _started(layout, ENVS)
    fast, reference = FastCamera(layout), ReferenceCamera(layout)
    frozen, driver = FrozenEncoder(encoder), FrozenExecutor(executor)
    frames = fast.frames(arena.pose, arena.slab, arena.scout[:, :2])  # (64, H, W)
    latent = frozen.latent(frames)  # (64, 64)
    action = driver.mean_action(latent, route)  # (64, 3)
    stages = {
        "our camera": lambda: fast.frames(arena.pose, arena.slab, arena.scout[:, :2]),
        "MuJoCo's camera": lambda: reference.pictures(arena.pose, arena.slab, arena.scout[:, :2]),
        "our physics": lambda: arena.step(action),
        "MuJoCo's physics": mujoco_step(arena, action),
        "encoder": lambda: frozen.latent(frames),
        "policy": lambda: driver.mean_action(latent, route),
    }
    cost = {stage: seconds / ENVS * 1e6 for stage, seconds in taking_turns(stages, rounds).items()}
    reference.close()
    shared = {stage: cost[stage] for stage in ("encoder", "policy")}
    whose = {"ours": "our", "MuJoCo": "MuJoCo's"}
    table = pd.DataFrame(
        {name: {part: cost[f"{by} {part}"] for part in ("camera", "physics")} | shared for name, by in whose.items()}
    )
    table.loc["whole step"] = table.sum()
    return table


def mujoco_step(arena: Arena, action: Float[np.ndarray, "n 3"]) -> Callable[[], Float[np.ndarray, "n 3"]]:
    """A call that has MuJoCo's own batch take a control step, at first from an arena's poses; returns the new ones."""
    model = mujoco.MjModel.from_xml_string(physics_xml(arena.layout))
    batch = Batch(model, arena.n, nthread=1)
    poses = batch.bind("qpos")
    poses[:], batch.bind("ctrl")[:] = arena.pose, arena.command(action)
    batch.bind("mocap_pos")[:, :-1, :2] = arena.layout.slab_centres[arena.slab]
    batch.bind("mocap_pos")[:, -1, :2] = arena.scout[:, :2]

    def step() -> Float[np.ndarray, "n 3"]:
        batch.step(None, nstep=PHYSICS_HZ // CONTROL_HZ)
        return poses

    return step


def control_step(
    layout: Layout, encoder: Result, executor: Result, envs: int, precision: str = "float32"
) -> Callable[[], None]:
    """A call that takes one control step in `envs` scenes side by side: frame, latent, velocity, physics."""
    arena, route = _started(layout, envs)
    camera, frozen, driver = FastCamera(layout), FrozenEncoder(encoder, precision=precision), FrozenExecutor(executor)

    def step() -> None:
        latent = frozen.latent(camera.frames(arena.pose, arena.slab, arena.scout[:, :2]))
        arena.step(driver.mean_action(latent, route))

    return step


class _Counting(FrozenEncoder):
    """A frozen encoder that remembers which frames it has taken."""

    def __init__(self, weights: Result):
        super().__init__(weights)
        self.taken: set[bytes] = set()

    def latent(self, observations):
        self.taken.update(frame.tobytes() for frame in observations)
        return super().latent(observations)


def encoder_passes(layout: Layout, encoder: Result) -> dict[str, int]:
    """Frames that the encoder takes in one control step of two robots which both need their latents, by message.

    A frame that was encoded already in this step is not counted again: its latent is at hand.
    """
    arena, _ = _started(layout, 1)
    poses, others = np.vstack([arena.pose, arena.scout]), np.vstack([arena.scout, arena.pose])[:, :2]
    frames = FastCamera(layout).frames(poses, np.repeat(arena.slab, 2), others)  # (2, H, W): navigator's, scout's
    counted = {}
    for content in ("floor", "latent"):
        counting = _Counting(encoder)
        counting.latent(frames)
        CONTENTS[content](Sender(layout, counting, frames[1:], arena.scout, np.zeros((1, 2)), arena.slab))
        counted[content] = len(counting.taken)
    return counted


def _started(layout: Layout, envs: int) -> tuple[Arena, np.ndarray]:
    """An arena at the start of its episodes, and a commanded route (envs,) for each."""
    arena, rng = Arena(layout, envs), np.random.default_rng(0)
    draws, route = draw_scenes(layout, envs, rng), rng.integers(0, len(layout.routes), envs)
    arena.reset(np.ones(envs, bool), draws.spawn, rng.integers(0, len(layout.placements), envs), draws.scout)
    return arena, route
