"""The bench of the hardware test (Section Hardware): where the robot is put down, and what it is asked about.

The robot stands behind the corridors' exits and looks at one of them. A decision is whether the slab blocks that one;
if it does not, it blocks the other, which the narrow crop leaves out. The same placements are drawn by the fast camera
(simulation) and by the surrogate camera.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import Layout
from lt_lib.settings.hardware import SessionConfig

OBJECTS = 12  # the most clutter there can be
CLUTTER = 9  # numbers an object: x, y (metres), half width, height (metres), yaw (radians), red, green, blue, shape
SLAB_JITTER = (0.02, 0.02, 0.07)  # metres, metres, radians: +- of the slab's place by hand


class Placements(NamedTuple):
    """P placements; lengths in metres, angles in radians."""

    hazard: Bool[np.ndarray, " p"]  # whether the slab blocks the corridor in question
    side: Int[np.ndarray, " p"]  # the corridor in question, 0 left, 1 right
    distance: Float[np.ndarray, " p"]  # from the camera to the slab's front, as on the label
    eye: Float[np.ndarray, "p 3"]
    slab_offset: Float[np.ndarray, "p 3"]
    clutter: Float[np.ndarray, "p objects 9"]
    dim: Bool[np.ndarray, " p"]

    @property
    def slab(self) -> Int[np.ndarray, " p"]:
        """The blocked corridor."""
        return np.where(self.hazard, self.side, 1 - self.side)


def draw_placements(layout: Layout, config: SessionConfig, rng: np.random.Generator) -> Placements:
    """The placements of a session, hazard and clear in random order, sides and lighting states in turn."""
    n, bench = config.hazard + config.clear, config.bench
    hazard = rng.permutation(np.arange(n) < config.hazard)
    side = rng.permutation(np.arange(n) % 2)
    dim = np.array([config.lighting[i % len(config.lighting)] == "dim" for i in range(n)])
    if config.marks:
        marks = np.linspace(config.near, config.far, config.marks) / 100
        distance = marks[rng.permutation(np.arange(n) % config.marks)]
    else:
        distance = rng.uniform(config.near, config.far, n) / 100
    jitter = np.array([bench.position / 100, bench.position / 100, np.deg2rad(bench.heading)])
    eye = stand(layout, side, distance, bench.turn) + rng.uniform(-1, 1, (n, 3)) * jitter
    slab_offset = rng.uniform(-1, 1, (n, 3)) * SLAB_JITTER
    return Placements(hazard, side, distance, eye, slab_offset, _clutter(layout, side, eye, rng), dim)


def stand(layout: Layout, side: Int[np.ndarray, " p"], distance: Float[np.ndarray, " p"], turn: float):
    """Camera poses (P, 3) on the centre line, `distance` metres behind the exits, turned `turn` degrees to a side."""
    front = layout.routes[0].slab.x[1]
    heading = np.pi + np.deg2rad(turn) * np.where(side == 0, -1.0, 1.0)
    return np.column_stack([front + distance, np.full(len(side), layout.scout.y), heading])


def _clutter(layout: Layout, side, eye, rng: np.random.Generator) -> Float[np.ndarray, "p objects 9"]:
    """Objects on the floor in front of the corridor in question, none of them red."""
    shape = (len(side), OBJECTS)
    ahead = rng.uniform(0.35, 0.95, shape)  # of the way from the camera to the slab
    across = rng.uniform(-0.75, 0.75, shape) * np.tan(np.deg2rad(layout.camera.fov / 2))
    depth = ahead * (eye[:, :1] - layout.routes[0].slab.x[1])
    cos, sin = np.cos(eye[:, 2:]), np.sin(eye[:, 2:])
    x, y = eye[:, :1] + depth * (cos - across * sin), eye[:, 1:2] + depth * (sin + across * cos)
    width, height = rng.uniform(0.02, 0.06, shape), rng.uniform(0.04, 0.22, shape)
    yaw, kind = rng.uniform(-np.pi, np.pi, shape), rng.integers(0, 3, shape)
    green, blue = rng.uniform(0.1, 0.8, shape), rng.uniform(0.1, 0.8, shape)
    red = rng.uniform(0.1, 1.0, shape) * np.maximum(green, blue)
    return np.stack([x, y, width, height, yaw, red, green, blue, kind.astype(float)], axis=-1)


def simulated_frames(layout: Layout, placements: Placements) -> UInt8[np.ndarray, "p h w"]:
    """The placements as the fast camera sees them, palette indices; no clutter, slab exactly in its place."""
    others = np.tile(layout.spawn.array[:2], (len(placements.side), 1))
    return FastCamera(layout).frames(placements.eye, placements.slab, others)
