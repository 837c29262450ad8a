"""Who can see the slab (Fig. 1c and d, Section Setup): hazard pixels, counted through any camera.

Under either placement, the navigator must not see the slab from where it chooses its corridor, and the scout must.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import Layout, Pose
from lt_lib.envs.materials import HAZARD
from lt_lib.settings.base import UserError

PIXELS = 512  # width and height of the paper's occlusion frame
SLAB = np.flatnonzero(HAZARD).astype(np.uint8)  # the slab's palette indices, which are consecutive
HEADINGS = np.arange(8) * np.pi / 4  # radians; neighbouring views overlap if the field of view exceeds 45 degrees


class Occlusion(NamedTuple):
    """Hazard pixels per frame. The last axis is the corridor that a slab stands in."""

    navigator: Int[np.ndarray, "points c"]
    scout: Int[np.ndarray, " c"]


class SightMap(NamedTuple):
    """`pixels` (X, Y): most hazard pixels in any of 8 headings at (x, y), metres; NaN where no robot can stand."""

    x: Float[np.ndarray, " x"]
    y: Float[np.ndarray, " y"]
    pixels: Float[np.ndarray, "x y"]


def hazard_pixels(
    camera, eyes: Float[np.ndarray, "b 3"], slabs, others: Float[np.ndarray, "b 2"]
) -> Int[np.ndarray, " b"]:
    """Hazard pixels in each frame. `camera` has the call of `FastCamera.frames`, which explains the other arguments."""
    frames = camera.frames(eyes, slabs, others)
    return ((frames >= SLAB[0]) & (frames <= SLAB[-1])).sum(axis=(1, 2))  # far faster than a look-up in HAZARD


def occlusion(layout: Layout, camera) -> Occlusion:
    """The paper's check: the navigator at every choice point and the scout at its post, one corridor blocked at a time.

    camera  draws the layout, or one that differs in nothing but how many corridors are blocked, with one
    """
    n = len(layout.routes)
    navigator = [under_each(camera, point, layout.scout, n) for point in layout.choice_points]
    return Occlusion(np.stack(navigator), under_each(camera, layout.scout, layout.spawn, n))


def under_each(camera, eye: Pose, other: Pose, placements: int) -> Int[np.ndarray, " c"]:
    """Hazard pixels from one pose under every placement of the slabs; the other robot stands at `other`."""
    eyes, others = (np.tile(each, (placements, 1)) for each in (eye.array, other.array[:2]))
    return hazard_pixels(camera, eyes, np.arange(placements), others)


def require_occlusion(layout: Layout) -> None:
    """Raises a one-line UserError if the navigator can see the slab from a choice point or the scout cannot see it."""
    seen = occlusion(layout, FastCamera(layout.model_copy(update={"blocked": (1,)}), PIXELS))
    for slab, side in enumerate(layout.sides):
        for i, pixels in enumerate(seen.navigator[:, slab]):
            if pixels:
                raise UserError(
                    f"layout {layout.name}: the navigator sees the {side} slab from choice_points[{i}] "
                    f"({pixels} of {PIXELS**2} pixels); move the point, or hide the slab behind a longer bend"
                )
        if not seen.scout[slab]:
            raise UserError(
                f"layout {layout.name}: the scout cannot see the slab in the {side} corridor; move or turn the scout"
            )


def sight_map(layout: Layout, slab: int, spacing: float = 0.1, pixels: int = 256) -> SightMap:
    """From where on the near side the slab (0 left, 1 right) is visible in at least one of 8 headings.

    spacing  metres between grid points
    pixels   width and height of the frames searched
    """
    x = np.arange(layout.arena.x[0], layout.barrier[0] + spacing / 2, spacing)
    y = np.arange(layout.arena.y[0], layout.arena.y[1] + spacing / 2, spacing)
    camera, most = FastCamera(layout, pixels), np.full((len(x), len(y)), np.nan)
    for i, j in np.argwhere(layout.free(x[:, None], y, layout.robot.radius)):
        eyes = np.column_stack([np.full_like(HEADINGS, x[i]), np.full_like(HEADINGS, y[j]), HEADINGS])
        others = np.tile(layout.scout.array[:2], (len(eyes), 1))
        most[i, j] = hazard_pixels(camera, eyes, np.full(len(eyes), slab), others).max()
    return SightMap(x, y, most)
