"""What can be seen from a cell of a grid: symmetric shadow-casting (Section Setup).

The view is scanned row by row in four quadrants; every row of cells narrows the sector that is still open. Slopes are
exact fractions, so that a ray along the edge between cells is a matter of rule and not of rounding: it passes if the
cells on one side of it are open all the way. Open cells are seen when their centre is, which makes seeing mutual; walls
when any of them is.
"""

from fractions import Fraction
from math import ceil, floor

import numpy as np
from jaxtyping import Bool

# A quadrant's (depth, offset) to (x, y).
QUADRANTS = (
    lambda depth, offset: (depth, offset),
    lambda depth, offset: (-depth, offset),
    lambda depth, offset: (offset, depth),
    lambda depth, offset: (offset, -depth),
)


def field_of_view(opaque: Bool[np.ndarray, "w h"], origin: tuple[int, int], radius: int) -> Bool[np.ndarray, "d d"]:
    """The cells that can be seen from `origin` within a square of side 2 * radius + 1 cells, centred on it.

    Cells outside the grid are opaque and never seen. Index [radius + dx, radius + dy].
    """
    seen = np.zeros((2 * radius + 1, 2 * radius + 1), bool)
    seen[radius, radius] = True
    for place in QUADRANTS:
        sectors = [(1, Fraction(-1), Fraction(1))]
        while sectors:
            depth, start, end = sectors.pop()
            if depth <= radius:
                sectors += _scan_row(opaque, origin, radius, place, depth, start, end, seen)
    return seen


def _scan_row(opaque, origin, radius, place, depth, start, end, seen):
    """Marks what is seen of one row of a sector; returns the sectors that stay open behind it."""
    behind, previous = [], None
    for offset in range(floor(depth * start + Fraction(1, 2)), ceil(depth * end - Fraction(1, 2)) + 1):
        dx, dy = place(depth, offset)
        x, y = origin[0] + dx, origin[1] + dy
        inside = 0 <= x < opaque.shape[0] and 0 <= y < opaque.shape[1]
        wall = not inside or bool(opaque[x, y])
        if inside and (wall or depth * start <= offset <= depth * end):
            seen[radius + dx, radius + dy] = True
        edge = Fraction(2 * offset - 1, 2 * depth)
        if wall and previous is False:
            behind.append((depth + 1, start, edge))
        if not wall and previous is True:
            start = edge
        previous = wall
    if previous is False:
        behind.append((depth + 1, start, end))
    return behind
