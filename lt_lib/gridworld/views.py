"""What the robots see in the gridworld: patches of cells, or frames rendered from the same cells.

With frames, nothing but the eyes changes: the map, its five moves, the channel, the receiver and the training are those
of the patches, so the protocol meets rendered pixels under discrete actions (Section From Grid Actions).
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import SIDES
from lt_lib.gridworld.map import Grid
from lt_lib.gridworld.patches import FrozenPatchEncoder
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.settings.base import UserError
from lt_lib.settings.gridworld import Scaled


class Views(NamedTuple):
    """What is seen under either placement from every cell, and by a scout at each of its posts; and what encodes it."""

    encoder: FrozenEncoder | FrozenPatchEncoder
    own: UInt8[np.ndarray, "p slab h w"]
    posts: UInt8[np.ndarray, "m slab h w"]


def cells(grid: Grid, weights: Mapping[str, np.ndarray]) -> Views:
    """The egocentric patches of 15 x 15 cells."""
    return Views(FrozenPatchEncoder(weights), grid.patches, grid.patches[grid.posts])


def pixels(grid: Grid, weights: Mapping[str, np.ndarray]) -> Views:
    """Rendered frames: the navigator looks along the corridors, the scout as its layout has it.

    The other robot stands where the layout has it, so a frame depends on cell and placement alone. Raises UserError if
    the placements look different from a choice cell.
    """
    layout = grid.layout
    own = _frames(grid, np.arange(len(grid.cells)), 0.0, layout.scout.array[:2])
    for point in layout.choice_points:
        cell = grid.at(point.x, point.y)
        if (own[cell, 0] != own[cell, 1]).any():
            raise UserError(f"layout {layout.name}: the slab shows in the frame at ({point.x}, {point.y}) m")
    posts = _frames(grid, grid.posts, layout.scout.array[2], layout.spawn.array[:2])
    return Views(FrozenEncoder(weights), own, posts)


def rescaled(weights: Mapping[str, np.ndarray], scaled: Scaled) -> Mapping[str, np.ndarray]:
    """Frozen weights with another normalisation of the latent than that fixed at the freeze, every dimension's own."""
    mean, std = weights["mean"], weights["std"]
    match scaled:
        case "each":
            return weights
        case "one":
            return {**weights, "std": np.full_like(std, np.sqrt(np.mean(std**2)))}
        case "none":
            return {**weights, "mean": np.zeros_like(mean), "std": np.ones_like(std)}


VIEWS = {"cells": cells, "pixels": pixels}


def _frames(
    grid: Grid, places: np.ndarray, heading: float, other: Float[np.ndarray, "2"]
) -> UInt8[np.ndarray, "n slab h w"]:
    poses = np.column_stack([grid.centres[places], np.full(len(places), heading)])  # (n, 3)
    camera, others = FastCamera(grid.layout), np.tile(other, (len(places), 1))
    frames = [camera.frames(poses, np.full(len(places), slab), others) for slab in range(len(SIDES))]
    return np.stack(frames, axis=1)
