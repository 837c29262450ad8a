"""The 64 x 64 forward camera (Section Setup): a batched column ray-caster over the layout's upright shapes.

Frames are palette indices, one byte a pixel. The scene is flat-lit, so an index names a material and the axis
that its face looks along, and the palette turns indices into colours. `reference.py` draws the same scene with
MuJoCo's own renderer behind the same call.
"""

import numba
import numpy as np
from jaxtyping import Float, UInt8

from lt_lib.envs.layout import SIDES, Layout

# One colour a face direction, so that a corner between two walls of one material can be seen.
MATERIALS = {
    "sky": (190, 215, 235),
    "floor": (120, 110, 100),
    "wall_x": (205, 200, 190),
    "wall_y": (165, 160, 155),
    "barrier_x": (95, 120, 160),
    "barrier_y": (60, 80, 120),
    "slab_x": (215, 40, 35),
    "slab_y": (165, 25, 25),
    "slab_z": (235, 80, 70),
    "goal": (60, 170, 75),
    "robot": (235, 190, 60),
}
INDEX = {name: i for i, name in enumerate(MATERIALS)}
PALETTE = np.array(list(MATERIALS.values()), dtype=np.uint8)  # (11, 3)
HAZARD = np.array([name.startswith("slab") for name in MATERIALS])  # (11,)
WALLS = np.array([name.startswith(("wall", "barrier")) for name in MATERIALS])  # (11,)
GOAL_PILLAR = (0.2, 0.6)  # radius, height in metres; smaller than the goal's radius, so never touched

_SKY, _FLOOR, _GOAL, _ROBOT = (INDEX[name] for name in ("sky", "floor", "goal", "robot"))
_SLAB = INDEX["slab_x"]
_FAR = np.float32(np.inf)
_FASTMATH = {"nnan", "nsz", "contract"}  # minima and maxima may be vectorised; infinities keep their meaning


class FastCamera:
    """Draws what a robot sees; float32 throughout, one thread."""

    def __init__(self, layout: Layout, pixels: int | None = None):
        self.pixels = pixels or layout.camera.pixels
        self._eye_height = np.float32(layout.camera.height)
        self._tan = np.float32(np.tan(np.deg2rad(layout.camera.fov) / 2))
        self._walls = np.array([wall.bounds for wall in layout.walls], np.float32)
        self._wall_index = np.array([INDEX[f"{wall.material}_x"] for wall in layout.walls], np.uint8)
        self._wall_height = np.float32(layout.wall_height)
        self._slabs = np.array([layout.slab(side).bounds for side in range(len(SIDES))], np.float32)
        self._slab_height = np.float32(layout.slab_height)
        self._goal = np.array([layout.goal.x, layout.goal.y, *GOAL_PILLAR], np.float32)
        self._robot = np.array([layout.robot.radius, layout.robot.height], np.float32)

    def frames(self, eyes: Float[np.ndarray, "b 3"], slabs, others: Float[np.ndarray, "b 2"]) -> UInt8[np.ndarray, "b h w"]:
        """Palette indices of what is seen.

        eyes    (B, 3) metres, metres, radians: the camera's pose
        slabs   (B,) 0 left, 1 right: the blocked corridor
        others  (B, 2) metres: where the other robot stands
        """
        out = np.empty((len(eyes), self.pixels, self.pixels), np.uint8)
        _draw(
            eyes.astype(np.float64), np.asarray(slabs).astype(np.int64), others.astype(np.float32), self._eye_height,
            self._tan, self._walls, self._wall_index, self._wall_height, self._slabs, self._slab_height,
            self._goal, self._robot, out,
        )
        return out


def colours(frames: UInt8[np.ndarray, "*batch h w"], palette: UInt8[np.ndarray, "colours 3"] = PALETTE):
    """RGB pictures (..., H, W, 3) uint8 of palette-index frames."""
    return palette[frames]


def network_input(frames: UInt8[np.ndarray, "b h w"], palette: UInt8[np.ndarray, "colours 3"] = PALETTE) -> Float[np.ndarray, "b h w 3"]:
    """Colours over 255, (B, H, W, 3) float32: the input scaling of the encoder and of the raw message."""
    out = np.empty((*frames.shape, 3), np.float32)
    _expand(frames.reshape(-1), palette.astype(np.float32) / np.float32(255), out.reshape(-1, 3))
    return out


@numba.njit(cache=True)
def _expand(indices, palette, out):
    for i in range(indices.shape[0]):
        for c in range(3):
            out[i, c] = palette[indices[i], c]


@numba.njit(cache=True, inline="always")
def _box_hit(ox, oy, ix, iy, box):
    """Depths at which a ray enters and leaves a footprint, and the axis it enters through; entry inf if missed.

    ix, iy are the inverses of the ray's direction.
    """
    x0, x1, y0, y1 = (box[0] - ox) * ix, (box[1] - ox) * ix, (box[2] - oy) * iy, (box[3] - oy) * iy
    near_x, near_y = min(x0, x1), min(y0, y1)
    near, far = max(near_x, near_y), min(max(x0, x1), max(y0, y1))
    missed = (near >= far) | (near <= 0)
    return (_FAR if missed else near), far, (0 if near_x >= near_y else 1)


@numba.njit(cache=True, inline="always")
def _disc_hit(ox, oy, dx, dy, cx, cy, radius):
    """Depths at which a ray enters and leaves a disc; entry inf if missed."""
    fx, fy = ox - cx, oy - cy
    a, b, c = dx * dx + dy * dy, fx * dx + fy * dy, fx * fx + fy * fy - radius * radius
    root = b * b - a * c
    if root <= 0 or c <= 0 or b >= 0:
        return _FAR, _FAR
    s = np.sqrt(root)
    return (-b - s) / a, (-b + s) / a


@numba.njit(cache=True, inline="always")
def _row(slope, inverse_pixel, size):
    """The first row whose centre lies below a slope (rise over depth)."""
    # clipped as a float: casting an infinity to an integer is undefined
    row = np.float32(0.5) * size - np.float32(0.5) - slope * inverse_pixel
    return int(np.ceil(min(max(row, np.float32(0)), size)))


@numba.njit(cache=True, fastmath=_FASTMATH)
def _nearest_walls(ox, oy, ix, iy, walls, index, nearest, colour):
    """Depth and palette index of the nearest wall in every column; a loop the compiler can vectorise."""
    nearest[:] = _FAR
    for w in range(walls.shape[0]):
        x0, x1, y0, y1 = walls[w, 0] - ox, walls[w, 1] - ox, walls[w, 2] - oy, walls[w, 3] - oy
        for c in range(nearest.shape[0]):
            near_x, far_x = min(x0 * ix[c], x1 * ix[c]), max(x0 * ix[c], x1 * ix[c])
            near_y, far_y = min(y0 * iy[c], y1 * iy[c]), max(y0 * iy[c], y1 * iy[c])
            near = max(near_x, near_y)
            hit = (near < min(far_x, far_y)) & (near > 0) & (near < nearest[c])
            nearest[c] = near if hit else nearest[c]
            colour[c] = (index[w] if near_x >= near_y else index[w] + 1) if hit else colour[c]


@numba.njit(cache=True, fastmath=_FASTMATH)
def _paint_walls(frame, top, bottom, colour):
    for row in range(frame.shape[0]):
        for c in range(frame.shape[1]):
            below = _FLOOR if row >= bottom[c] else colour[c]
            frame[row, c] = _SKY if row < top[c] else below


@numba.njit(cache=True)
def _draw(eyes, slabs, others, eye, tan, walls, wall_index, wall_height, slab_boxes, slab_height, goal, robot, out):
    pixels = out.shape[1]
    size = np.float32(pixels)
    pixel = np.float32(2) * tan / size
    inverse = np.float32(1) / pixel
    slope = tan - (np.arange(pixels).astype(np.float32) + np.float32(0.5)) * pixel
    nearest, colour = np.empty(pixels, np.float32), np.empty(pixels, np.int32)
    top, bottom = np.empty(pixels, np.int32), np.empty(pixels, np.int32)
    dx, dy = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    ix, iy = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    depth, leave = np.empty(3, np.float32), np.empty(3, np.float32)
    height = np.array([slab_height, goal[3], robot[1]], np.float32)
    front, lid = np.array([_SLAB, _GOAL, _ROBOT], np.uint8), np.array([_SLAB + 2, _GOAL, _ROBOT], np.uint8)
    for i in range(eyes.shape[0]):
        ox, oy = np.float32(eyes[i, 0]), np.float32(eyes[i, 1])
        cos, sin = np.float32(np.cos(eyes[i, 2])), np.float32(np.sin(eyes[i, 2]))
        for c in range(pixels):
            dx[c], dy[c] = cos - slope[c] * sin, sin + slope[c] * cos
            ix[c], iy[c] = np.float32(1) / dx[c], np.float32(1) / dy[c]
        _nearest_walls(ox, oy, ix, iy, walls, wall_index, nearest, colour)
        for c in range(pixels):
            top[c] = _row((wall_height - eye) / nearest[c], inverse, size)
            bottom[c] = _row(-eye / nearest[c], inverse, size)
        frame, box = out[i], slab_boxes[slabs[i]]
        _paint_walls(frame, top, bottom, colour)

        for c in range(pixels):
            depth[0], leave[0], axis = _box_hit(ox, oy, ix[c], iy[c], box)
            depth[1], leave[1] = _disc_hit(ox, oy, dx[c], dy[c], goal[0], goal[1], goal[2])
            depth[2], leave[2] = _disc_hit(ox, oy, dx[c], dy[c], others[i, 0], others[i, 1], robot[0])
            front[0] = np.uint8(_SLAB + axis)
            while min(depth[0], depth[1], depth[2]) < nearest[c]:  # the farthest first
                far = np.float32(-1)
                for j in range(3):
                    if far < depth[j] < nearest[c]:
                        far, k = depth[j], j
                depth[k] = _FAR
                edge = _row((height[k] - eye) / far, inverse, size)
                frame[edge : _row(-eye / far, inverse, size), c] = front[k]
                if height[k] < eye:
                    frame[_row((height[k] - eye) / leave[k], inverse, size) : edge, c] = lid[k]
