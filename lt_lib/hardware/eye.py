"""The surrogate camera on a robot that drives: frame by frame, behind the call of `FastCamera.frames`."""

import numpy as np
from jaxtyping import Float, UInt8

from lt_lib.envs.layout import Layout
from lt_lib.hardware import optics
from lt_lib.hardware.surrogate import Light, SurrogateScene
from lt_lib.settings.hardware import OpticsConfig

SIZE = (optics.CROP, optics.CROP)  # only the crop is rendered, at the frame's centre


class SurrogateEye:
    """What robots see through the surrogate camera: the encoder's RGB crop; needs OpenGL.

    light  bright or dim, with the lamps beyond the barrier, or even, which lights the near side too
    stops  by which all light is lowered
    """

    def __init__(self, layout: Layout, config: OpticsConfig, light: Light, stops: float, rng: np.random.Generator):
        width, height = optics.rendered_size(SIZE)
        self._scene = SurrogateScene(layout, width, height, optics.FOCAL * optics.OVERSAMPLING)
        self._config, self._light, self._level, self._rng = config, light, 2.0**-stops, rng
        self._pictures: dict[int, tuple[bytes, np.ndarray]] = {}  # by row: of which scene, and how it looks

    def frames(
        self, eyes: Float[np.ndarray, "b 3"], slabs, others: Float[np.ndarray, "b 2"]
    ) -> UInt8[np.ndarray, "b 64 64 3"]:
        """Arguments as for `FastCamera.frames`; every frame is an exposure of its own."""
        rows = zip(eyes, slabs, others, strict=True)
        return np.stack([self._exposed(self._picture(row, *scene)) for row, scene in enumerate(rows)])

    def close(self) -> None:
        self._scene.close()

    def _picture(self, row: int, eye, slab, other) -> UInt8[np.ndarray, "h w 3"]:
        """The rendered scene, rendered again only if something has moved: rendering takes most of a step."""
        scene = np.array([*eye, slab, *other], float).tobytes()
        if self._pictures.get(row, (b"",))[0] != scene:
            self._pictures[row] = scene, self._scene.sight(eye, int(slab), other, self._light)
        return self._pictures[row][1]

    def _exposed(self, picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "64 64 3"]:
        shot = optics.draw_shot(self._config, self._rng)
        shot = shot._replace(exposure=self._level * shot.exposure)
        return optics.expose(picture, self._config, shot, self._rng, SIZE)
