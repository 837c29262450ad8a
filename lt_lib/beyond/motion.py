"""How a scout drives while the navigator waits: a patrol that cannot know the answer, or an errand that gives it away.

Paths are kinematic, at the robots' speeds; they keep to the free room, so no physics is needed to follow them.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from lt_lib.envs.arena import CONTROL_HZ, V_MAX, W_MAX
from lt_lib.envs.layout import Layout

STEP, TURN = V_MAX / CONTROL_HZ, W_MAX / CONTROL_HZ  # metres and radians per control step
CLEAR = 0.3  # metres from walls, and from whatever stands in front of the barrier
ABOUT = np.deg2rad(40)  # how far a scout that watches the barrier looks aside


def patrols(
    layout: Layout, n: int, steps: int, watching: float, rng: np.random.Generator
) -> Float[np.ndarray, "n t 3"]:
    """Poses on the way from one random place beyond the barrier to the next; where the slabs stand plays no part.

    watching  probability that a scout faces the barrier on its way to a place; else it looks anywhere
    """
    low, high = room(layout)
    here, heading = rng.uniform(low, high, (n, 2)), _headings(n, watching, rng)
    target, facing = rng.uniform(low, high, (n, 2)), _headings(n, watching, rng)
    poses = np.empty((n, steps, 3))
    for t in range(steps):
        poses[:, t] = np.column_stack([here, heading])
        here, arrived = towards(here, target)
        heading = turned(heading, facing)
        target = np.where(arrived[:, None], rng.uniform(low, high, (n, 2)), target)
        facing = np.where(arrived, _headings(n, watching, rng), facing)
    return poses


def errands(
    layout: Layout, free: Int[np.ndarray, " n"], steps: int, rng: np.random.Generator
) -> Float[np.ndarray, "n t 3"]:
    """Poses on the way from the navigator's side to the goal through a corridor that is free, (n,)."""
    start = layout.spawn.sample(len(free), rng)[:, :2]
    ways = np.array([_way(layout, corridor) for corridor in range(len(layout.routes))])  # (c, points, 2)
    leg, here, heading = np.zeros(len(free), int), start, np.zeros(len(free))
    poses = np.empty((len(free), steps, 3))
    for t in range(steps):
        poses[:, t] = np.column_stack([here, heading])
        target = ways[free, leg]
        facing = np.arctan2(*(target - here).T[::-1])
        here, arrived = towards(here, target)
        heading = turned(heading, facing)
        leg = np.minimum(leg + arrived, ways.shape[1] - 1)
    return poses


def room(layout: Layout) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Corners of the free rectangle beyond the barrier and its slabs, metres."""
    front = max(corridor.slab.x[1] for corridor in layout.routes)
    (_, x1), (y0, y1), radius = layout.arena.x, layout.arena.y, layout.robot.radius + CLEAR
    return np.array([front + radius, y0 + radius]), np.array([x1 - radius, y1 - radius])


def towards(
    here: Float[np.ndarray, "n 2"], target: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """One control step straight towards targets, and which of them are reached."""
    away = target - here
    distance = np.hypot(*away.T)
    arrived = distance <= STEP
    share = np.where(arrived, 1.0, STEP / np.maximum(distance, STEP))
    return here + share[:, None] * away, arrived


def turned(heading: Float[np.ndarray, " n"], facing: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Headings after one control step of turning the shorter way."""
    rest = (facing - heading + np.pi) % (2 * np.pi) - np.pi
    return heading + np.clip(rest, -TURN, TURN)


def _headings(n: int, watching: float, rng: np.random.Generator) -> Float[np.ndarray, " n"]:
    at_barrier, anywhere = np.pi + rng.uniform(-ABOUT, ABOUT, n), rng.uniform(-np.pi, np.pi, n)
    return np.where(rng.random(n) < watching, at_barrier, anywhere)


def _way(layout: Layout, corridor: int) -> list[tuple[float, float]]:
    """Points in the middle of a corridor's legs, from before its mouth to the goal."""
    first, bend, last = (layout.routes[corridor].legs[i] for i in (0, 1, -1))
    mouth, out, across = sum(first.y) / 2, sum(last.y) / 2, sum(bend.x) / 2
    beyond = layout.barrier[1] + CLEAR
    return [(first.x[0] - CLEAR, mouth), (across, mouth), (across, out), (beyond, out), (layout.goal.x, layout.goal.y)]
