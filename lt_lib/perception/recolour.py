"""Compiled: palette-index frames to colours, each frame with a palette and a texture of its own.

Kept apart from the annotated functions that call it, since compiled code must not be wrapped by run-time shape checks.
"""

import numpy as np

from lt_lib.envs.compiled import compiled


@compiled()
def paint(indices, palettes, textures, textured, out):
    one = np.float32(1)
    for b in range(indices.shape[0]):
        for y in range(indices.shape[1]):
            for x in range(indices.shape[2]):
                k = indices[b, y, x]
                gain = one + textures[b, y, x] if textured[k] else one
                for c in range(3):
                    out[b, y, x, c] = min(max(palettes[b, k, c] * gain, np.float32(0)), one)
