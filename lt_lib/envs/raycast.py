"""The compiled loops of the ray-caster, which draw every frame of `FastCamera` one column of pixels at a time.

They stand apart from the annotated functions that call them, because run-time shape checks must not wrap compiled code.

Shapes: B frames of P x P pixels, W walls. The robot's eye stands at (ox, oy) at height `eye`. In column c, the ray's
direction per unit of depth is (dx, dy), with inverses (ix, iy). A ray enters a footprint at depth `enter`, which is
infinite if it misses, and leaves it at depth `leave`.
"""

import numpy as np

from lt_lib.envs.compiled import compiled
from lt_lib.envs.materials import INDEX

_SKY, _FLOOR, _GOAL, _ROBOT = (np.uint8(INDEX[name]) for name in ("sky", "floor", "goal", "robot"))
_SLAB, _SLAB_TOP = np.uint8(INDEX["slab_x"]), np.uint8(INDEX["slab_z"])
_FAR = np.float32(np.inf)
_FASTMATH = {"nnan", "nsz"}  # lets minima and maxima be vectorised; infinities keep their meaning


@compiled()
def expand(indices, red, green, blue, out):
    """Writes the three channels of every palette index: indices (N,), tables (colours,), out (N, 3)."""
    # three tables and no inner loop over channels are twice as fast
    for i in range(indices.size):
        k = indices[i]
        out[i, 0], out[i, 1], out[i, 2] = red[k], green[k], blue[k]


@compiled(inline="always")
def _never_zero(direction):
    """Turns a ray exactly along an axis by less than float32 resolves, so that its inverse is finite."""
    return direction if direction != 0 else np.float32(1e-20)


@compiled(inline="always")
def _row(slope, inverse_pixel, size):
    """The first row whose centre lies below a slope (rise over depth)."""
    # clipped as a float, because casting an infinity to an integer is undefined
    row = np.float32(0.5) * size - np.float32(0.5) - slope * inverse_pixel
    return int(np.ceil(min(max(row, np.float32(0)), size)))


@compiled(fastmath=_FASTMATH)
def _nearest_walls(ox, oy, ix, iy, walls, index, nearest, colour):
    """Depth `nearest` (P,) and palette index `colour` (P,) of the nearest wall in every column; walls are (W, 4)."""
    nearest[:] = _FAR
    for w in range(walls.shape[0]):
        x0, x1, y0, y1 = walls[w, 0] - ox, walls[w, 1] - ox, walls[w, 2] - oy, walls[w, 3] - oy
        along_x, along_y = index[w], index[w] + 1
        for c in range(nearest.shape[0]):
            near_x, far_x = min(x0 * ix[c], x1 * ix[c]), max(x0 * ix[c], x1 * ix[c])
            near_y, far_y = min(y0 * iy[c], y1 * iy[c]), max(y0 * iy[c], y1 * iy[c])
            near = max(near_x, near_y)
            hit = (near < min(far_x, far_y)) & (near > 0) & (near < nearest[c])
            nearest[c] = near if hit else nearest[c]
            colour[c] = (along_x if near_x >= near_y else along_y) if hit else colour[c]


@compiled(fastmath=_FASTMATH)
def _meet_box(ox, oy, ix, iy, box, enter, leave, axis):
    """Where every column's ray meets a box (4,), and the axis (0 x, 1 y) that the face it enters points along."""
    x0, x1, y0, y1 = box[0] - ox, box[1] - ox, box[2] - oy, box[3] - oy
    for c in range(enter.shape[0]):
        near_x, far_x = min(x0 * ix[c], x1 * ix[c]), max(x0 * ix[c], x1 * ix[c])
        near_y, far_y = min(y0 * iy[c], y1 * iy[c]), max(y0 * iy[c], y1 * iy[c])
        near, far = max(near_x, near_y), min(far_x, far_y)
        enter[c] = near if (near < far) & (near > 0) else _FAR
        leave[c] = far
        axis[c] = near_x < near_y


@compiled(fastmath=_FASTMATH)
def _meet_disc(ox, oy, dx, dy, cx, cy, radius, enter, leave):
    """Where every column's ray meets a disc: the roots of a quadratic in depth."""
    fx, fy = ox - cx, oy - cy
    outside = fx * fx + fy * fy - radius * radius  # positive: the eye stands outside the disc
    for c in range(enter.shape[0]):
        a, b = dx[c] * dx[c] + dy[c] * dy[c], fx * dx[c] + fy * dy[c]
        discriminant = b * b - a * outside
        root = np.sqrt(max(discriminant, np.float32(0)))
        enter[c] = (-b - root) / a if (discriminant > 0) & (outside > 0) & (b < 0) else _FAR
        leave[c] = (-b + root) / a


@compiled()
def _paint_walls(frame, top, bottom, colour):
    """Sky, wall and floor of a frame (P, P): column c shows its wall from row top[c] to row bottom[c]."""
    for row in range(frame.shape[0]):
        line = np.int16(row)  # as wide as the rows that it is compared with
        for c in range(frame.shape[1]):
            below = _FLOOR if line >= bottom[c] else colour[c]
            frame[row, c] = _SKY if line < top[c] else below


@compiled()
def _paint_objects(frame, enter, leave, axis, nearest, rise, eye, inverse):
    """Paints slabs, goal pillar and robot over the walls, the farthest first in every column.

    enter, leave  (n, P) depths of n - 2 slabs, the pillar and the robot
    axis          (n - 2, P) of the slabs' faces
    rise          (n,) heights of their tops above the eye
    """
    size, n = np.float32(frame.shape[0]), enter.shape[0]
    pillar = n - 2
    for c in range(frame.shape[1]):
        while True:
            far, k = np.float32(-1), -1  # the farthest object in front of the wall, and its number
            for j in range(n):
                if far < enter[j, c] < nearest[c]:
                    far, k = enter[j, c], j
            if k < 0:
                break
            enter[k, c] = _FAR  # painted
            front = _SLAB + axis[k, c] if k < pillar else (_GOAL if k == pillar else _ROBOT)
            edge = _row(rise[k] / far, inverse, size)
            frame[edge : _row(-eye / far, inverse, size), c] = front
            if rise[k] < 0:  # the top is visible from above
                frame[_row(rise[k] / leave[k, c], inverse, size) : edge, c] = _SLAB_TOP if k < pillar else front


@compiled()
def draw(eyes, slabs, others, eye, tan, walls, wall_index, wall_height, slab_boxes, slab_height, goal, robot, out):
    """Draws B frames into out (B, P, P), as palette indices; lengths in metres, angles in radians.

    eyes (B, 3), slabs (B,), others (B, 2): as in `FastCamera.frames`
    walls (W, 4), slab_boxes (placements, slabs, 4): footprints (x0, x1, y0, y1)
    wall_index (W,): palette index of each wall's x faces; its y faces follow it
    goal (4,): x, y, radius, height;  robot (2,): radius, height;  tan: of half the field of view
    """
    pixels = out.shape[1]
    size = np.float32(pixels)
    pixel = np.float32(2) * tan / size  # width of a pixel at unit depth
    inverse = np.float32(1) / pixel
    slope = tan - (np.arange(pixels).astype(np.float32) + np.float32(0.5)) * pixel  # (P,), positive to the left
    # one allocation per array (P,): arrays that share one could overlap, and then no loop would be vectorised
    dx, dy, nearest = np.empty(pixels, np.float32), np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    ix, iy = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    top, bottom = np.empty(pixels, np.int16), np.empty(pixels, np.int16)
    boxes = slab_boxes.shape[1]
    colour, axis = np.empty(pixels, np.uint8), np.empty((boxes, pixels), np.uint8)
    enter, leave = np.empty((boxes + 2, pixels), np.float32), np.empty((boxes + 2, pixels), np.float32)
    rise = np.full(boxes + 2, slab_height - eye, np.float32)  # (boxes + 2,)
    rise[boxes], rise[boxes + 1] = goal[3] - eye, robot[1] - eye
    for i in range(eyes.shape[0]):
        ox, oy = np.float32(eyes[i, 0]), np.float32(eyes[i, 1])
        cos, sin = np.float32(np.cos(eyes[i, 2])), np.float32(np.sin(eyes[i, 2]))
        for c in range(pixels):
            dx[c], dy[c] = _never_zero(cos - slope[c] * sin), _never_zero(sin + slope[c] * cos)
            ix[c], iy[c] = np.float32(1) / dx[c], np.float32(1) / dy[c]
        _nearest_walls(ox, oy, ix, iy, walls, wall_index, nearest, colour)
        for c in range(pixels):
            top[c] = _row((wall_height - eye) / nearest[c], inverse, size)
            bottom[c] = _row(-eye / nearest[c], inverse, size)
        _paint_walls(out[i], top, bottom, colour)
        for k in range(boxes):
            _meet_box(ox, oy, ix, iy, slab_boxes[slabs[i], k], enter[k], leave[k], axis[k])
        _meet_disc(ox, oy, dx, dy, goal[0], goal[1], goal[2], enter[boxes], leave[boxes])
        _meet_disc(ox, oy, dx, dy, others[i, 0], others[i, 1], robot[0], enter[boxes + 1], leave[boxes + 1])
        _paint_objects(out[i], enter, leave, axis, nearest, rise, eye, inverse)
