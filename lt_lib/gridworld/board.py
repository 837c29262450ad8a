"""The gridworld's map and what a robot sees of it, in the notebook's figures and in its film."""

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from lt_lib.gridworld.map import CELL, FREE, GOAL, HAZARD, RADIUS, UNKNOWN, WALL, Grid
from lt_lib.report.scene import SCOUT

COLOURS = {
    UNKNOWN: ("not seen", "#3b3b3b"),
    FREE: ("free", "#f4f1ea"),
    WALL: ("wall", "#7d8ca3"),
    HAZARD: ("hazard slab", "#a50f15"),
    GOAL: ("goal", "#7fcdbb"),
}
REVEALING = "#b8860b"  # dots
CELLS = ListedColormap([colour for _, colour in COLOURS.values()])


def board(axes: Axes, grid: Grid, slab: int) -> None:
    """Draws the map in metres under one placement; dotted cells are those from which the placements differ."""
    codes = np.where(grid.wall, WALL, FREE)
    codes[tuple(grid.cells[grid.goal].T)] = GOAL
    codes[tuple(grid.cells[grid.slab[slab]].T)] = HAZARD
    low, high = grid.centres.min(0) - 1.5 * CELL, grid.centres.max(0) + 1.5 * CELL  # the ring of outer wall too
    extent = (low[0], high[0], low[1], high[1])
    axes.imshow(codes.T, origin="lower", extent=extent, cmap=CELLS, vmin=UNKNOWN, vmax=GOAL)
    axes.plot(*grid.centres[grid.revealing].T, ".", color=REVEALING, ms=4)
    axes.plot(*grid.centres[grid.posts].T, "s", color=SCOUT, ms=6)
    axes.set(xlabel="x (m)", ylabel="y (m)")


def patch(axes: Axes, codes: UInt8[np.ndarray, "h w"], colour: str, title: str) -> None:
    """Draws what one robot sees, itself in the middle."""
    axes.imshow(codes.T, origin="lower", cmap=CELLS, vmin=UNKNOWN, vmax=GOAL)
    axes.plot(RADIUS, RADIUS, "o", color=colour, ms=5, mec="white")
    axes.set_title(title, fontsize=8.5)
    axes.set(xticks=[], yticks=[])
