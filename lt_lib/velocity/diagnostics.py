"""The standard diagnostics for a navigator that ignores its message (Section From Grid Actions to Velocity Commands).

They test perception, channel and controller; in the paper they find no fault in any of the three.
"""

import numpy as np
from jaxtyping import Bool, Float
from sklearn.linear_model import LogisticRegression

from lt_lib.comm.channel import ANCHOR
from lt_lib.envs.arena import CONTROL_HZ, V_MAX, W_MAX, Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import SIDES, Layout
from lt_lib.perception.encoder import ACTION, FrozenEncoder
from lt_lib.pixels.episodes import draw_scenes
from lt_lib.settings.base import LATENCY
from lt_lib.velocity.navigator import Scouts

SETTLED = 2  # control steps after which a newly commanded velocity is reached


def probe_right(
    layout: Layout, encoder: FrozenEncoder, draws: int, rng: np.random.Generator
) -> Bool[np.ndarray, " held_out"]:
    """Which held-out draws a linear probe gets right that reads the blocked corridor off the scout's latent.

    draws  of the scene; the probe is fitted to the first half and scored on the second
    """
    slab, scenes = rng.integers(0, len(SIDES), draws), draw_scenes(layout, draws, rng)
    latents = encoder.latent(FastCamera(layout).frames(scenes.scout, slab, scenes.spawn[:, :2])).cpu().numpy()
    half = draws // 2
    probe = LogisticRegression(max_iter=2000).fit(latents[:half], slab[:half])
    return probe.predict(latents[half:]) == slab[half:]


def message_error(
    layout: Layout, encoder: FrozenEncoder, draws: int, rng: np.random.Generator, latency: int = LATENCY
) -> float:
    """Largest difference, over all floats, between what the scout sends and what arrives after the latency."""
    slab, scenes, everyone = rng.integers(0, len(SIDES), draws), draw_scenes(layout, draws, rng), np.ones(draws, bool)
    arena, scouts = Arena(layout, draws), Scouts(layout, encoder, "latent", draws, latency)
    arena.reset(everyone, scenes.spawn, slab, scenes.scout)
    scouts.look(everyone, arena, slab)
    sent = encoder.latent(FastCamera(layout).frames(scenes.scout, slab, scenes.spawn[:, :2])).cpu()
    for age in range(latency + 1):
        received = scouts.wires(arena, np.full(draws, age))[:, ANCHOR:]
        arena.step(np.zeros((draws, ACTION)))
    return float((received - sent).abs().max())


def command_error(layout: Layout, draws: int, rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Largest difference per axis between commanded and reached body velocity from the spawn, in full speeds."""
    arena, scenes = Arena(layout, draws), draw_scenes(layout, draws, rng)
    arena.reset(np.ones(draws, bool), scenes.spawn, np.zeros(draws, np.int64), scenes.scout)
    command = rng.uniform(-1, 1, (draws, ACTION))
    command[:, -1] = 0.0  # without turning, the robot moves on a straight line
    for _ in range(SETTLED):
        arena.step(command)
    before = arena.pose
    arena.step(command)
    moved, heading = (arena.pose - before) * CONTROL_HZ, before[:, 2]  # (b, 3), (b,)
    forward = np.cos(heading) * moved[:, 0] + np.sin(heading) * moved[:, 1]
    across = -np.sin(heading) * moved[:, 0] + np.cos(heading) * moved[:, 1]
    reached = np.column_stack([forward / V_MAX, across / V_MAX, moved[:, 2] / W_MAX])
    return np.abs(reached - command).max(axis=0)
