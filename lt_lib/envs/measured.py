"""The scene's settings measured where they act: in simulated time, in metres driven, in a rendered frame."""

import numpy as np

from lt_lib.envs.arena import Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import Layout
from lt_lib.envs.materials import INDEX

FINE = 4096  # pixels of the frame in which the field of view is measured: a hundredth of a degree
FILLED = 0.6  # of the frame's angle, by the robot that stands before the camera then
UNDER_WAY = 5  # control steps after which a robot drives at full speed


def rates(layout: Layout) -> tuple[float, float]:
    """Control and physics steps per second of simulated time."""
    arena = Arena(layout, 1)
    before = arena.time[0]
    arena.step(np.zeros((1, 3)))
    return 1 / (arena.time[0] - before), 1 / arena.timestep


def speeds(layout: Layout) -> tuple[float, float]:
    """Metres per second and radians per second under full command, over one control step at full speed."""
    arena = Arena(layout, 2)
    spawn = np.tile(layout.spawn.array, (2, 1))
    arena.reset(np.ones(2, bool), spawn, np.zeros(2, np.int64), np.tile(layout.scout.array, (2, 1)))
    command = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # sideways, and turning
    for _ in range(UNDER_WAY):
        arena.step(command)
    before, since = arena.pose, arena.time[0]
    arena.step(command)
    moved, passed = arena.pose - before, arena.time[0] - since
    return float(np.hypot(*moved[0, :2]) / passed), float(moved[1, 2] / passed)


def field_of_view(layout: Layout) -> float:
    """Degrees that a frame subtends, from how many columns a robot of known size and distance fills."""
    half = np.deg2rad(FILLED * layout.camera.fov / 2)  # of the angle under which it appears, wherever that is
    eye, apart = layout.spawn.array, layout.robot.radius / np.sin(half)  # metres
    other = eye[:2] + apart * np.array([np.cos(eye[2]), np.sin(eye[2])])
    frame = FastCamera(layout, FINE).frames(eye[None], [0], other[None])[0]  # (FINE, FINE)
    columns = (frame == INDEX["robot"]).any(axis=0).sum()
    return float(2 * np.rad2deg(np.arctan(np.tan(half) * FINE / columns)))
