"""The 64 x 64 forward camera (Section Setup): a batched column ray-caster over the layout's upright shapes.

A frame holds one palette index per pixel, one byte each. The scene is flat-lit, so an index names a material and the
axis that the face points along, and the palette turns indices into colours. `reference.py` draws the same scene with
MuJoCo's own renderer behind the same call.
"""

import numpy as np
from jaxtyping import Float, UInt8

from lt_lib.envs.layout import Layout
from lt_lib.envs.materials import GOAL_PILLAR, INDEX, PALETTE
from lt_lib.envs.raycast import draw, expand


class FastCamera:
    """Draws what a robot sees, in float32 and on one thread."""

    def __init__(self, layout: Layout, pixels: int | None = None, slabs: Float[np.ndarray, "p k 4"] | None = None):
        """slabs: footprints (x0, x1, y0, y1) of k slabs under each of p placements, the layout's own by default."""
        self.pixels = pixels or layout.camera.pixels
        self._eye_height = np.float32(layout.camera.height)
        self._tan = np.float32(np.tan(np.deg2rad(layout.camera.fov) / 2))
        self._walls = np.array([wall.bounds for wall in layout.walls], np.float32)  # (W, 4) x0, x1, y0, y1
        self._wall_index = np.array([INDEX[f"{wall.material}_x"] for wall in layout.walls], np.uint8)  # (W,)
        self._wall_height = np.float32(layout.wall_height)
        self._slabs = np.array(layout.slabs if slabs is None else slabs, np.float32)  # (placements, slabs, 4)
        self._slab_height = np.float32(layout.slab_height)
        self._goal = np.array([layout.goal.x, layout.goal.y, *GOAL_PILLAR], np.float32)  # (4,) x, y, radius, height
        self._robot = np.array([layout.robot.radius, layout.robot.height], np.float32)  # (2,)

    def frames(
        self, eyes: Float[np.ndarray, "b 3"], slabs, others: Float[np.ndarray, "b 2"]
    ) -> UInt8[np.ndarray, "b h w"]:
        """Palette indices (B, H, W) of what each camera sees.

        eyes    (B, 3) the camera's pose: metres, metres, radians
        slabs   (B,) the placement of the slabs; with two corridors, the blocked one: 0 left, 1 right
        others  (B, 2) the other robot's position, metres
        """
        out = np.empty((len(eyes), self.pixels, self.pixels), np.uint8)
        draw(
            eyes.astype(np.float64),
            np.asarray(slabs).astype(np.int64),
            others.astype(np.float32),
            self._eye_height,
            self._tan,
            self._walls,
            self._wall_index,
            self._wall_height,
            self._slabs,
            self._slab_height,
            self._goal,
            self._robot,
            out,
        )
        return out


def colours(frames: UInt8[np.ndarray, "*batch h w"], palette: UInt8[np.ndarray, "colours 3"] = PALETTE):
    """Frames of palette indices as RGB pictures (..., H, W, 3), uint8."""
    return palette[frames]


def network_input(
    frames: UInt8[np.ndarray, "b h w"], palette: UInt8[np.ndarray, "colours 3"] = PALETTE
) -> Float[np.ndarray, "b h w 3"]:
    """Colours divided by 255, (B, H, W, 3) float32: the input scaling of the encoder and of the raw message."""
    out = np.empty((*frames.shape, 3), np.float32)
    red, green, blue = np.ascontiguousarray(palette.T.astype(np.float32) / np.float32(255))  # (colours,) each
    expand(frames.reshape(-1), red, green, blue, out.reshape(-1, 3))
    return out
