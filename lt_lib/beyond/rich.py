"""Scenes with more to tell than one bit: which corridor is bad, how deep, where the goal stands, who else is there.

The slab is a mat of costly ground in front of one corridor's exit, low enough for the scout to see how far it reaches.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lt_lib.envs.camera import FastCamera, colours
from lt_lib.envs.layout import SIDES, Layout, load_layout

MAT = 0.1  # metres high
DEPTHS = (0.1, 1.5)  # metres that a mat reaches from the barrier into the room, uniform
GOALS = (-1.6, 0.0, 1.6)  # where the goal may stand, metres along y
GOAL_X, COMPANY_X, SCOUT_X = 2.4, 2.0, 4.2  # metres: the goal's row, the second robot's, the scout's post


class RichScenes(NamedTuple):
    """N scenes: what is true in them (for rewards and messages by hand alone), and what the scout sees."""

    slab: Int[np.ndarray, " n"]  # the corridor with the mat, 0 left, 1 right
    depth: Float[np.ndarray, " n"]  # metres
    goal: Int[np.ndarray, " n"]  # a place of GOALS
    company: Bool[np.ndarray, " n"]  # whether a second robot stands in front of the scout
    detour: Float[np.ndarray, " n"]  # metres of mat that the receiver's own detour is worth; no scout sees it
    scout: Float[np.ndarray, "n 3"]
    pictures: UInt8[np.ndarray, "n h w 3"]

    def take(self, which) -> "RichScenes":
        return RichScenes(*(values[which] for values in self))


def rich_layout(name: str) -> Layout:
    """A layout of two corridors with the scout farther back, the mat's height, and the goal in sight."""
    layout = load_layout(name)
    post = layout.scout.model_copy(update={"x": SCOUT_X})
    return layout.model_copy(update={"scout": post, "slab_height": MAT})


def draw_rich_scenes(layout: Layout, n: int, rng: np.random.Generator) -> RichScenes:
    """Everything independent of everything else.

    layout  of `rich_layout`
    """
    slab, goal, company = rng.integers(0, len(SIDES), n), rng.integers(0, len(GOALS), n), rng.random(n) < 0.5
    depth, detour = rng.uniform(*DEPTHS, (2, n))
    scout = layout.scout.sample(n, rng)
    place = np.column_stack([COMPANY_X + rng.uniform(-0.3, 0.3, n), rng.uniform(-1.2, 1.2, n)])
    others = np.where(company[:, None], place, layout.spawn.array[:2])  # behind the barrier nobody is seen
    pictures = np.empty((n, layout.camera.pixels, layout.camera.pixels, 3), np.uint8)
    for i, y in enumerate(GOALS):
        there = goal == i
        camera = FastCamera(_with_goal(layout, y), slabs=mats(layout, slab[there], depth[there]))
        pictures[there] = colours(camera.frames(scout[there], np.arange(there.sum()), others[there]))
    return RichScenes(slab, depth, goal, company, detour, scout, pictures)


def mats(layout: Layout, slab: Int[np.ndarray, " n"], depth: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 1 4"]:
    """Footprints of mats that reach so far into the room from the exits of corridors."""
    exits = np.array([corridor.slab.y for corridor in layout.routes])  # (2, 2)
    start = np.full(len(slab), layout.barrier[1])
    return np.column_stack([start, start + depth, exits[slab]])[:, None]


def _with_goal(layout: Layout, y: float) -> Layout:
    return layout.model_copy(update={"goal": layout.goal.model_copy(update={"x": GOAL_X, "y": y})})
