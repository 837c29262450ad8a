"""Rollouts in the gridworld: since a policy's inputs are few, its action probabilities are a table to walk through."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lt_lib.envs.compiled import compiled
from lt_lib.envs.layout import SIDES
from lt_lib.gridworld.map import GOAL_REWARD, HORIZON, MOVES, SLAB_REWARD, STEP_REWARD, Grid
from lt_lib.settings.base import LATENCY

DRAWS = 4  # uniform numbers per step: action, spawn, slab, post


class States(NamedTuple):
    """n environments: the navigator's cell, the slab's corridor, the scout's post, steps since the start, each (n,)."""

    cell: Int[np.ndarray, " n"]
    slab: Int[np.ndarray, " n"]
    post: Int[np.ndarray, " n"]
    clock: Int[np.ndarray, " n"]

    def message(self, latency: int) -> Int[np.ndarray, " n"]:
        """0 before the first message has arrived, then one more than the scout's post."""
        return np.where(self.clock < latency, 0, self.post + 1)


class Walks(NamedTuple):
    """T steps of n environments, each (T, n): what was seen, done and earned, and where it led before any reset."""

    message: Int[np.ndarray, "t n"]
    cell: Int[np.ndarray, "t n"]
    slab: Int[np.ndarray, "t n"]
    action: Int[np.ndarray, "t n"]
    reward: Float[np.ndarray, "t n"]
    following: Int[np.ndarray, "t n"]  # the cell that the step led to
    terminated: Bool[np.ndarray, "t n"]  # in the goal or the slab
    ended: Bool[np.ndarray, "t n"]  # terminated or timed out
    arrived: Bool[np.ndarray, "t n"]
    length: Int[np.ndarray, "t n"]  # of the episode so far, this step included


def first_states(grid: Grid, n: int, rng: np.random.Generator) -> States:
    """n episodes at their start."""
    return States(
        rng.choice(grid.spawn, n), rng.integers(0, len(SIDES), n), rng.integers(0, len(grid.posts), n), np.zeros(n, int)
    )


def walk(
    grid: Grid,
    probs: Float[np.ndarray, "m p 2 a"],
    states: States,
    steps: int,
    rng: np.random.Generator,
    latency: int = LATENCY,
) -> tuple[Walks, States]:
    """Samples actions from a table over (message, cell, slab) for some steps; ended episodes start anew."""
    uniform = rng.random((steps, len(states.cell), DRAWS))
    steps_taken, last = _walk(
        np.cumsum(probs, axis=-1),
        grid.following,
        grid.slab,
        grid.goal,
        grid.spawn,
        len(grid.posts),
        latency,
        np.stack(states),
        uniform,
    )
    integers = dict(zip(("message", "cell", "slab", "action", "following", "length"), steps_taken, strict=True))
    following = integers["following"]
    arrived = grid.goal[following]
    terminated = arrived | grid.slab[integers["slab"], following]
    reward = np.where(arrived, GOAL_REWARD, np.where(terminated, SLAB_REWARD, STEP_REWARD)).astype(np.float32)
    ended = terminated | (integers["length"] == HORIZON)
    return Walks(reward=reward, terminated=terminated, ended=ended, arrived=arrived, **integers), States(*last)


@compiled()
def _walk(cumulative, following, slab_cells, goal, spawn, posts, latency, states, uniform):
    steps, n = uniform.shape[:2]
    out, states = np.empty((6, steps, n), np.int64), states.copy()
    for i in range(n):
        cell, slab, post, clock = states[:, i]
        for t in range(steps):
            message = 0 if clock < latency else post + 1
            action = 0
            while action < len(MOVES) - 1 and uniform[t, i, 0] >= cumulative[message, cell, slab, action]:
                action += 1
            there, clock = following[cell, action], clock + 1
            out[:, t, i] = message, cell, slab, action, there, clock
            cell = there
            if goal[there] or slab_cells[slab, there] or clock == HORIZON:
                cell, clock = spawn[int(uniform[t, i, 1] * len(spawn))], 0
                slab, post = int(uniform[t, i, 2] * 2), int(uniform[t, i, 3] * posts)
        states[:, i] = cell, slab, post, clock
    return out, states
