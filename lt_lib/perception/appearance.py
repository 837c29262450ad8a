"""Floor and walls in random colours, guided by the segmentation (Section Hardware).

The fast camera's frames are palette indices, so each pixel names its material: floor and walls get random colours and
blotches, everything else keeps the simulation's.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lt_lib.envs.materials import INDEX, PALETTE
from lt_lib.perception.recolour import paint

SIZES = (6, 24)  # blotches along a side of a frame, coarse and fine
NOT_RED = 1.5  # times the larger of green and blue: no floor or wall gets as red as the slab
SHADES = (0.55, 1.0)  # the darker of two face directions, relative to the other
SURFACES = (("floor",), ("wall_x", "wall_y"), ("barrier_x", "barrier_y"))  # materials that share a random colour
TEXTURED = np.zeros(len(PALETTE), bool)
TEXTURED[[INDEX[name] for names in SURFACES for name in names]] = True


class Appearances(NamedTuple):
    """How n rollouts look."""

    palettes: Float[np.ndarray, "n colours 3"]  # in [0, 1]
    textures: Float[np.ndarray, "n h w"]  # brightness of floor and walls relative to their colour, minus 1

    def of(self, which) -> "Appearances":
        return Appearances(self.palettes[which], self.textures[which])


def draw_appearances(n: int, pixels: int, colour: float, texture: float, rng: np.random.Generator) -> Appearances:
    """colour: share of the own colour that a random one replaces; texture: standard deviation of the blotches."""
    palettes = draw_palettes(n, colour, rng)
    return Appearances(palettes, _blotches(n, pixels, texture, rng))


def draw_palettes(n: int, colour: float, rng: np.random.Generator) -> Float[np.ndarray, "n colours 3"]:
    """Colours in [0, 1] of every material, floor and walls random to the share `colour`."""
    own = np.tile(PALETTE.astype(np.float32) / 255, (n, 1, 1))
    random = own.copy()
    for names in SURFACES:
        base = rng.uniform(0.08, 1.0, (n, 3))
        base[:, 0] = np.minimum(base[:, 0], NOT_RED * base[:, 1:].max(1))
        shade = np.ones((n, 2))
        shade[np.arange(n), rng.integers(0, 2, n)] = rng.uniform(*SHADES, n)
        for i, name in enumerate(names):
            random[:, INDEX[name]] = base * shade[:, i, None]
    return (1 - colour) * own + np.float32(colour) * random


def _blotches(n: int, pixels: int, deviation: float, rng: np.random.Generator) -> Float[np.ndarray, "n h w"]:
    out = np.zeros((n, pixels, pixels), np.float32)
    for size in SIZES:
        coarse = rng.normal(0, deviation / np.sqrt(len(SIZES)), (n, size, size)).astype(np.float32)
        out += [cv2.resize(each, (pixels, pixels), interpolation=cv2.INTER_CUBIC) for each in coarse]
    return out


def recoloured(frames: UInt8[np.ndarray, "b h w"], looks: Appearances) -> Float[np.ndarray, "b h w 3"]:
    """Colours in [0, 1] of palette-index frames, each in its own appearance."""
    out = np.empty((*frames.shape, 3), np.float32)
    paint(frames, looks.palettes.astype(np.float32), looks.textures, TEXTURED, out)
    return out


def eight_bits(colours: Float[np.ndarray, "*shape 3"]) -> UInt8[np.ndarray, "*shape 3"]:
    return np.round(colours * 255).astype(np.uint8)
