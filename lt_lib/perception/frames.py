"""Random rollouts from uniform free poses, without labels or reward: the encoder's frames (Section Implementation)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from lt_lib.envs.arena import Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import Layout
from lt_lib.envs.materials import HAZARD, WALLS

HOLD = 0.9  # probability that a random action is kept for another step instead of drawn anew
ARENAS = 640  # rollouts stepped side by side


class Rollouts(NamedTuple):
    """R rollouts of T steps: frames of palette indices, actions in [-1, 1], poses in metres, metres, radians.

    `slab` is the placement of the slabs; no self-supervised training looks at it.
    """

    frames: UInt8[np.ndarray, "r t h w"]
    actions: Float[np.ndarray, "r t 3"]
    poses: Float[np.ndarray, "r t 3"]
    slab: Int[np.ndarray, " r"]


def random_rollouts(layout: Layout, rollouts: int, length: int, rng: np.random.Generator) -> Rollouts:
    """Rollouts of `length` frames; each draws its own slab corridor and its own pose of the other robot."""
    parts = [_rollouts(layout, min(ARENAS, rollouts - start), length, rng) for start in range(0, rollouts, ARENAS)]
    return Rollouts(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _rollouts(layout: Layout, n: int, length: int, rng: np.random.Generator) -> Rollouts:
    arena, camera = Arena(layout, n), FastCamera(layout)
    slab = rng.integers(0, len(layout.placements), n)
    other = free_poses(layout, slab, rng)
    pose = free_poses(layout, slab, rng, apart_from=other)
    arena.reset(np.ones(n, bool), pose, slab, other)
    frames, actions, poses = [], [], []
    action = rng.uniform(-1, 1, (n, 3))
    for _ in range(length):
        frames.append(camera.frames(arena.pose, slab, other[:, :2]))
        poses.append(arena.pose)
        action = np.where(rng.random((n, 1)) < HOLD, action, rng.uniform(-1, 1, (n, 3)))
        actions.append(action.astype(np.float32))
        arena.step(action)
    return Rollouts(*(np.stack(part, axis=1) for part in (frames, actions, poses)), slab)


def free_poses(
    layout: Layout, slab: Int[np.ndarray, " n"], rng: np.random.Generator, apart_from=None
) -> Float[np.ndarray, "n 3"]:
    """Uniform poses over the free arena, clear of walls, of the slabs and of the robots at `apart_from`.

    slab        (n,) the placement of the slabs
    apart_from  (n, 2) or (n, 3) metres, or None
    """
    n, radius = len(slab), layout.robot.radius
    pose, missing = np.empty((n, 3)), np.ones(n, bool)
    low, high = np.array([layout.arena.x, layout.arena.y]).T
    while missing.any():
        xy = rng.uniform(low, high, (n, 2))
        x, y = xy.T
        good = layout.free(x, y, radius) & (layout.slab_distance(slab, x, y) > radius)
        if apart_from is not None:
            good &= np.hypot(*(xy - apart_from[:, :2]).T) > 2 * radius
        take = missing & good
        pose[take] = np.column_stack([xy, rng.uniform(-np.pi, np.pi, n)])[take]
        missing &= ~take
    return pose


def hazard_visible(frames: UInt8[np.ndarray, "*batch h w"]):
    """Whether each frame shows the slab; for probes and figures, never for training."""
    return HAZARD[frames].any(axis=(-1, -2))


def wall_pixels(frames: UInt8[np.ndarray, "*batch h w"]):
    """How many pixels of each frame show a wall; for probes, never for training."""
    return WALLS[frames].sum(axis=(-1, -2))
