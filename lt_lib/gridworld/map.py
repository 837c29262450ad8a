"""The scene on 0.5 m cells, where one action moves a whole cell (Sections Setup, Gridworld).

The map, what can be seen from every cell and where every action leads are all made from a `Layout` once; an episode is
then a walk through these tables. The navigator wins by reaching the goal, and loses by entering the slab.
"""

from collections.abc import Iterator
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import label

from lt_lib.envs.layout import SIDES, Layout
from lt_lib.gridworld.shadowcast import field_of_view
from lt_lib.settings.base import UserError

CELL = 0.5  # metres
RADIUS = 7  # cells seen in each direction
PATCH = 2 * RADIUS + 1
UNKNOWN, FREE, WALL, HAZARD, GOAL = CODES = range(5)
MOVES = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])  # of the five actions, in cells
STAY = 0
HORIZON = 100  # steps
STEP_REWARD, GOAL_REWARD, SLAB_REWARD = -0.005, 1.0, -0.1


class Grid:
    """A layout's free cells, numbered 0 to p - 1 (the slab's cells among them), and all that follows from them.

    Raises UserError, one line, for a layout that does not lie on the cells, has a robot where no free cell is, or a
    goal that cannot be reached through either corridor.
    """

    def __init__(self, layout: Layout):
        _require_on_grid(layout)
        self.layout = layout
        low, high = np.array([layout.arena.x, layout.arena.y]).T
        origin, size = low - CELL, np.rint((high - low) / CELL).astype(int) + 2  # with a ring of outer wall
        x, y = origin[:, None, None] + CELL * (np.indices(size) + 0.5)  # centres, metres
        self.wall: Bool[np.ndarray, "w h"] = ~layout.free(x, y)
        self.cells: Int[np.ndarray, "p 2"] = np.argwhere(~self.wall)
        self.centres: Float[np.ndarray, "p 2"] = origin + CELL * (self.cells + 0.5)
        self.index: Int[np.ndarray, "w h"] = np.full(size, -1)
        self.index[tuple(self.cells.T)] = np.arange(len(self.cells))
        self.slab: Bool[np.ndarray, "2 p"] = np.stack([c.slab.contains(*self.centres.T) for c in layout.routes])
        self.goal: Bool[np.ndarray, " p"] = (
            np.hypot(self.centres[:, 0] - layout.goal.x, self.centres[:, 1] - layout.goal.y) <= layout.goal.radius
        )
        self.spawn, self.posts = self._within("spawn"), self._within("scout")
        self._require_routes()

    @cached_property
    def following(self) -> Int[np.ndarray, "p 5"]:
        """The cell that each action leads to; into a wall is staying."""
        there = self.index[tuple(np.moveaxis(self.cells[:, None] + MOVES, -1, 0))]
        return np.where(there >= 0, there, np.arange(len(self.cells))[:, None])

    @cached_property
    def patches(self) -> UInt8[np.ndarray, "p 2 15 15"]:
        """What is seen from every cell under either placement, egocentric; the slab hides what is behind it."""
        out = np.empty((len(self.cells), len(SIDES), PATCH, PATCH), np.uint8)
        for side in range(len(SIDES)):
            codes = np.where(self.wall, WALL, FREE)
            codes[tuple(self.cells[self.goal].T)] = GOAL
            codes[tuple(self.cells[self.slab[side]].T)] = HAZARD
            opaque, around = (codes == WALL) | (codes == HAZARD), np.pad(codes, RADIUS)
            for i, (x, y) in enumerate(self.cells):
                seen = field_of_view(opaque, (x, y), RADIUS)
                out[i, side] = np.where(seen, around[x : x + PATCH, y : y + PATCH], UNKNOWN)
        return out

    @cached_property
    def revealing(self) -> Bool[np.ndarray, " p"]:
        """The cells from which the two placements look different."""
        return (self.patches[:, 0] != self.patches[:, 1]).any((1, 2))

    def at(self, x: float, y: float) -> int:
        """The number of the free cell that holds a point in metres. Raises UserError if there is none."""
        nearest = np.abs(self.centres - (x, y)).max(1)
        if nearest.min() > CELL / 2 + 1e-9:
            raise UserError(f"layout {self.layout.name}: ({x}, {y}) m is in no free cell")
        return int(nearest.argmin())

    def _within(self, name: str) -> Int[np.ndarray, " n"]:
        """The free cells, none the slab's, whose centres a jittered pose can take."""
        pose = getattr(self.layout, name)
        near = (np.abs(self.centres - (pose.x, pose.y)) <= np.array(pose.jitter[:2]) + 1e-9).all(1)
        found = np.flatnonzero(near & ~self.slab.any(0))
        if len(found) == 0:
            raise UserError(
                f"layout {self.layout.name}: {name} at ({pose.x}, {pose.y}) ± {list(pose.jitter[:2])} m holds the "
                f"centre of no free cell; centres lie {CELL / 2} m from the arena's corner and every {CELL} m"
            )
        return found

    def _require_routes(self):
        """Each corridor alone must lead from every spawn cell to the goal."""
        if not self.goal.any():
            goal = self.layout.goal
            raise UserError(
                f"layout {self.layout.name}: no free cell's centre lies within {goal.radius} m of the goal at "
                f"({goal.x}, {goal.y})"
            )
        for side, name in enumerate(SIDES):
            open_cells = ~self.wall
            open_cells[tuple(self.cells[self.slab[1 - side]].T)] = False
            region = label(open_cells)[0][tuple(self.cells.T)]
            if not set(region[self.spawn]) <= set(region[self.goal]):
                raise UserError(
                    f"layout {self.layout.name}: the goal cannot be reached from every spawn cell through the {name} "
                    "corridor; join its legs cell to cell"
                )


def _require_on_grid(layout: Layout) -> None:
    for name, origin, value in _edges(layout):
        cells = (value - origin) / CELL
        if abs(cells - round(cells)) > 1e-6:
            raise UserError(
                f"layout {layout.name}: {name} has an edge at {value} m, off the grid of {CELL} m cells; move it to "
                f"{origin + CELL * round(cells)} m"
            )


def _edges(layout: Layout) -> Iterator[tuple[str, float, float]]:
    """Every edge that must lie between two cells: its name, the arena's corner on that axis, and where it is."""
    x0, y0 = layout.arena.x[0], layout.arena.y[0]
    rects = {"arena": layout.arena}
    for side, corridor in zip(SIDES, layout.routes, strict=True):
        rects |= {f"corridors.{side}.legs[{i}]": leg for i, leg in enumerate(corridor.legs)}
        rects[f"corridors.{side}.slab"] = corridor.slab
    for name, rect in rects.items():
        yield from ((f"{name}.x", x0, value) for value in rect.x)
        yield from ((f"{name}.y", y0, value) for value in rect.y)
    yield from (("barrier", x0, value) for value in layout.barrier)


def require_occluded_choices(grid: Grid) -> None:
    """Raises UserError unless every choice cell looks the same, cell for cell, under either placement of the slab."""
    for point in grid.layout.choice_points:
        cell = grid.at(point.x, point.y)
        if grid.revealing[cell]:
            differ = int((grid.patches[cell, 0] != grid.patches[cell, 1]).sum())
            raise UserError(
                f"layout {grid.layout.name}: from the choice cell at ({point.x}, {point.y}) m the placements of the "
                f"slab differ in {differ} of {PATCH**2} cells; move the slab or its corridor's bend out of sight"
            )
