"""Scenes that make the scout's view harder to read, one difficulty at a time; none is tuned to a sender.

The navigator, its executor and the outcome of every route are those of the episode bank: what changes is the picture
that the scout sends about the slab.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import SIDES, Layout
from lt_lib.envs.materials import HAZARD, INDEX, PALETTE
from lt_lib.envs.occlusion import hazard_pixels
from lt_lib.perception.appearance import draw_palettes, eight_bits
from lt_lib.settings.base import UserError
from lt_lib.settings.beyond import Rung

OBJECT_NEAR, OBJECT_FAR = 0.6, 2.0  # metres from the scout to an object in its view
TRIES = 1_000  # rounds of drawing poses before a scene is called impossible


class Scenes(NamedTuple):
    """Where the robots stand in E scenes (metres, radians), and what the scout sees under either placement."""

    spawn: Float[np.ndarray, "e 3"]
    scout: Float[np.ndarray, "e 3"]
    pictures: UInt8[np.ndarray, "e slab h w 3"]
    slab_pixels: Int[np.ndarray, "e slab"]


def draw_ladder_scenes(layout: Layout, rung: Rung, spawn: Float[np.ndarray, "e 3"], rng: np.random.Generator) -> Scenes:
    """Scenes of a rung with the navigator waiting at its spawn."""
    scout = scouts(layout, rung, spawn, rng)
    camera, n = FastCamera(layout), len(scout)
    others = spawn[:, :2] if rung.redness is None else objects(layout, scout, rng)
    frames = np.stack([camera.frames(scout, np.full(n, slab), others) for slab in range(len(SIDES))], axis=1)
    flat = frames.reshape(-1, *frames.shape[2:])  # (e * slab, h, w)
    return Scenes(spawn, scout, photographed(flat, rung, rng).reshape(*frames.shape, 3), HAZARD[frames].sum((2, 3)))


def scouts(
    layout: Layout, rung: Rung, spawn: Float[np.ndarray, "e 3"], rng: np.random.Generator
) -> Float[np.ndarray, "e 3"]:
    """Where the scout stands in each scene: about its post, or anywhere that shows it the slab."""
    if not rung.anywhere:
        post = layout.scout.model_copy(
            update={
                "x": layout.scout.x + rung.back,
                "jitter": tuple(rung.jitter * each for each in layout.scout.jitter),
            }
        )
        return post.sample(len(spawn), rng)
    return drawn(len(spawn), lambda n: _beyond_the_barrier(layout, n, rng), lambda pose: _seeing(layout, rung, pose))


def objects(layout: Layout, scout: Float[np.ndarray, "e 3"], rng: np.random.Generator) -> Float[np.ndarray, "e 2"]:
    """A free place beyond the barrier in front of each scout, for an upright object of the robot's size."""
    half, radius = np.deg2rad(layout.camera.fov) / 2, layout.robot.radius
    out, missing = np.empty((len(scout), 2)), np.ones(len(scout), bool)
    for _ in range(TRIES):
        away, aside = rng.uniform(OBJECT_NEAR, OBJECT_FAR, len(scout)), rng.uniform(-half, half, len(scout))
        x, y = (scout[:, :2] + away[:, None] * _directions(scout[:, 2] + aside)).T
        good = layout.free(x, y, radius) & (_slab_distance(layout, x, y) > radius) & (x > layout.barrier[1])
        out[missing & good] = np.column_stack([x, y])[missing & good]
        missing &= ~good
        if not missing.any():
            return out
    raise UserError(f"layout {layout.name}: no room for an object in front of the scout; move the scout into the open")


def photographed(
    frames: UInt8[np.ndarray, "n h w"], rung: Rung, rng: np.random.Generator
) -> UInt8[np.ndarray, "n h w 3"]:
    """Pictures of palette-index frames as a rung shows them, each in a palette of its own."""
    if rung.noise:
        random = rng.integers(0, len(PALETTE), frames.shape, dtype=np.uint8)
        frames = np.where(rng.random(frames.shape, np.float32) < rung.noise, random, frames)
    palettes = draw_palettes(len(frames), rung.appearance, rng)
    if rung.redness is not None:
        own, red = (PALETTE[INDEX[name]] / 255 for name in ("robot", "slab_x"))
        palettes[:, INDEX["robot"]] = (1 - rung.redness) * own + rung.redness * red
    if rung.exposure:
        palettes *= np.exp2(rng.normal(0, rung.exposure, (len(frames), 1, 1))).astype(np.float32)
    shown = eight_bits(np.minimum(palettes, 1))
    out = np.empty((*frames.shape, 3), np.uint8)
    for i in range(len(frames)):  # one small look-up after another is faster than a large one
        np.take(shown[i], frames[i], axis=0, out=out[i])
    return out


def drawn(n: int, propose, accept) -> Float[np.ndarray, "n 3"]:
    """The first n of proposed poses that are accepted; raises UserError where next to none is."""
    kept: list[np.ndarray] = []
    for _ in range(TRIES):
        poses = propose(max(n, 256))
        kept.append(poses[accept(poses)])
        if sum(map(len, kept)) >= n:
            return np.concatenate(kept)[:n]
    raise UserError("rungs: no scout beyond the barrier sees the slab; expected a smaller `least`, or another layout")


def _beyond_the_barrier(layout: Layout, n: int, rng: np.random.Generator) -> Float[np.ndarray, "m 3"]:
    (_, low), (_, high) = layout.barrier, layout.arena.x
    x, y = rng.uniform(low, high, n), rng.uniform(*layout.arena.y, n)
    radius = layout.robot.radius
    clear = layout.free(x, y, radius) & (_slab_distance(layout, x, y) > radius)
    away = np.hypot(x - layout.goal.x, y - layout.goal.y) > layout.goal.radius
    return np.column_stack([x, y, rng.uniform(-np.pi, np.pi, n)])[clear & away]


def _seeing(layout: Layout, rung: Rung, pose: Float[np.ndarray, "m 3"]) -> Bool[np.ndarray, " m"]:
    camera, nobody = FastCamera(layout), np.tile(layout.spawn.array[:2], (len(pose), 1))
    seen = [hazard_pixels(camera, pose, np.full(len(pose), slab), nobody) for slab in range(len(SIDES))]
    return np.maximum(*seen) >= rung.least


def _directions(headings: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    return np.column_stack([np.cos(headings), np.sin(headings)])


def _slab_distance(layout: Layout, x, y) -> Float[np.ndarray, " n"]:
    """To the nearer of both places of the slab, metres."""
    return np.minimum(*(layout.slab_distance(np.full(len(x), side), x, y) for side in range(len(SIDES))))


def label(rung: Rung | Mapping) -> str:
    """What a rung changes, e.g. 'anywhere + noise 0.1'."""
    changed = Rung(**dict(rung)).model_dump(exclude_defaults=True)
    words = [name if value is True else f"{name} {value:g}" for name, value in changed.items()]
    return " + ".join(words) or "the paper's scene"
