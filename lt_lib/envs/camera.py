"""The 64 x 64 forward camera (Section Setup): a batched column ray-caster over the layout's upright shapes.

Frames are palette indices, one byte a pixel. The scene is flat-lit, so an index names a material and the axis
that its face looks along, and the palette turns indices into colours. `reference.py` draws the same scene with
MuJoCo's own renderer behind the same call.
"""

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from lt_lib.envs.layout import SIDES, Layout
from lt_lib.envs.materials import GOAL_PILLAR, INDEX, PALETTE
from lt_lib.envs.raycast import draw, expand


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

    def frames(
        self, eyes: Float[np.ndarray, "b 3"], slabs, others: Float[np.ndarray, "b 2"]
    ) -> UInt8[np.ndarray, "b h w"]:
        """Palette indices of what is seen.

        eyes    (B, 3) metres, metres, radians: the camera's pose
        slabs   (B,) 0 left, 1 right: the blocked corridor
        others  (B, 2) metres: where the other robot stands
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
    """RGB pictures (..., H, W, 3) uint8 of palette-index frames."""
    return palette[frames]


def network_input(
    frames: UInt8[np.ndarray, "b h w"], palette: UInt8[np.ndarray, "colours 3"] = PALETTE
) -> Float[np.ndarray, "b h w 3"]:
    """Colours over 255, (B, H, W, 3) float32: the input scaling of the encoder and of the raw message."""
    return looked_up(frames, palette.astype(np.float32) / np.float32(255))


def looked_up(
    frames: UInt8[np.ndarray, "b h w"], table: Shaped[np.ndarray, "colours 3"]
) -> Shaped[np.ndarray, "b h w 3"]:
    """The table's row for every pixel, in the table's own type."""
    out = np.empty((*frames.shape, 3), table.dtype)
    red, green, blue = np.ascontiguousarray(table.T)
    expand(frames.reshape(-1), red, green, blue, out.reshape(-1, 3))
    return out
