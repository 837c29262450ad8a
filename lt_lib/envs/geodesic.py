"""Walking distance to the goal through one corridor, the executor's potential (Section Implementation)."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from lt_lib.envs.layout import NO_CORRIDOR, Layout
from lt_lib.settings.base import UserError

RESOLUTION = 0.05  # metres
MARGIN = 0.02  # metres; extra clearance from every wall


class RouteDistance:
    """Distance in metres from points (n, 2) to the goal through one corridor; of two, the left (0) or the right (1).

    Raises UserError if the spawn cannot reach the goal through one of them.
    """

    def __init__(self, layout: Layout):
        self._origin = np.array([layout.arena.x[0], layout.arena.y[0]])
        self._maps = np.stack([_distance_map(layout, side) for side in range(len(layout.routes))])  # (C, X, Y)

    def __call__(self, position: Float[np.ndarray, "n 2"], route) -> Float[np.ndarray, " n"]:
        cells = (position - self._origin) / RESOLUTION  # (n, 2)
        return map_coordinates(self._maps, [np.asarray(route), cells[:, 0], cells[:, 1]], order=1, mode="nearest")


def _distance_map(layout: Layout, side: int) -> Float[np.ndarray, "x y"]:
    xs = np.arange(layout.arena.x[0], layout.arena.x[1] + RESOLUTION / 2, RESOLUTION)
    ys = np.arange(layout.arena.y[0], layout.arena.y[1] + RESOLUTION / 2, RESOLUTION)
    x, y = np.meshgrid(xs, ys, indexing="ij")  # (X, Y)
    radius = layout.robot.radius
    free = layout.free(x, y, radius + MARGIN) & np.isin(layout.corridor_at(x, y), (side, NO_CORRIDOR))  # (X, Y)
    free &= np.hypot(x - layout.scout.x, y - layout.scout.y) > 2 * radius + 2 * MARGIN
    goal = (np.abs(xs - layout.goal.x).argmin(), np.abs(ys - layout.goal.y).argmin())
    distance = dijkstra(_grid_graph(free), indices=np.ravel_multi_index(goal, free.shape)).reshape(free.shape)
    spawn = (np.abs(xs - layout.spawn.x).argmin(), np.abs(ys - layout.spawn.y).argmin())
    if not np.isfinite(distance[spawn]):
        raise UserError(
            f"layout {layout.name}: the goal cannot be reached from the spawn through the {layout.sides[side]} "
            "corridor; join the corridor's legs and keep the scout out of the way"
        )
    gap, nearest = distance_transform_edt(~np.isfinite(distance), sampling=RESOLUTION, return_indices=True)
    return distance[tuple(nearest)] + gap


def _grid_graph(free):
    """Edges between free neighbouring cells, including diagonals, weighted by their length in metres."""
    index = np.arange(free.size).reshape(free.shape)
    tails, heads, weights = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
        a = (slice(0, free.shape[0] - dx), slice(max(0, -dy), free.shape[1] - max(0, dy)))
        b = (slice(dx, None), slice(max(0, dy), free.shape[1] + min(0, dy)))
        both = free[a] & free[b]
        tails.append(index[a][both])
        heads.append(index[b][both])
        weights.append(np.full(both.sum(), RESOLUTION * np.hypot(dx, dy)))
    edges = (np.concatenate(weights), (np.concatenate(tails), np.concatenate(heads)))
    graph = coo_matrix(edges, shape=(free.size, free.size))
    return graph + graph.T
