"""GIFs of one episode: the arena from above, the navigator's camera and the scout's, side by side."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v3 as iio
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from lt_lib.envs.arena import CONTROL_HZ, HORIZON, Arena
from lt_lib.envs.camera import FastCamera, colours
from lt_lib.envs.layout import Layout
from lt_lib.envs.reference import TopView
from lt_lib.perception.encoder import Frozen, FrozenEncoder
from lt_lib.pixels.episodes import Draws
from lt_lib.pixels.executor import FrozenExecutor
from lt_lib.pixels.route import read_head, sent_wires
from lt_lib.store.run import Result

BAND = 22  # pixels of caption above the pictures


class Take(NamedTuple):
    """One recorded episode: poses (T, 3) of the navigator, the scout's (3,), placement of the slabs, and route."""

    poses: Float[np.ndarray, "t 3"]
    scout: Float[np.ndarray, "3"]
    slab: int
    route: int


def record(
    layout: Layout,
    camera: Any,
    encoder: Frozen,
    executor: FrozenExecutor,
    draws: Draws,
    entry: int,
    slab: int,
    route: int,
    commit_step: int,
    horizon: int = HORIZON,
) -> Take:
    """Drives one draw of the scene to the goal or the time-out, keeping the navigator's poses.

    Arguments as for `pixels.episodes.drive`.
    """
    arena, scout = Arena(layout, 1), draws.scout[entry : entry + 1]
    arena.reset(np.ones(1, bool), draws.spawn[entry : entry + 1], np.array([slab]), scout)
    poses = [arena.pose[0]]
    while not arena.reached[0] and len(poses) <= horizon:
        latent = encoder.latent(camera.frames(arena.pose, arena.slab, scout[:, :2]))
        waiting = len(poses) <= commit_step
        arena.step(np.zeros((1, 3)) if waiting else executor.mean_action(latent, np.array([route])))
        poses.append(arena.pose[0])
    return Take(np.stack(poses), scout[0], slab, route)


def pictures(layout: Layout, take: Take, every: int, title: str, height: int = 200) -> list[UInt8[np.ndarray, "h w 3"]]:
    """One captioned picture every `every` control steps."""
    top, eye = TopView(layout, 2 * height), FastCamera(layout, height)
    slab, frames = np.array([take.slab]), []
    for step in range(0, len(take.poses), every):
        pose = take.poses[step]
        above = np.asarray(from_above(top, pose, take.slab, take.scout, height))
        seen = colours(eye.frames(pose[None], slab, take.scout[None, :2]))[0]
        sent = colours(eye.frames(take.scout[None], slab, pose[None, :2]))[0]
        gap = np.full((height, 6, 3), 255, np.uint8)
        slabs = " ".join(layout.sides[side] for side in layout.placements[take.slab])
        words = f"{title}: slab {slabs}, head chose {layout.sides[take.route]}; {step / CONTROL_HZ:.0f} s"
        frames.append(captioned(np.concatenate([above, gap, seen, gap, sent], axis=1), words, above.shape[1]))
    return frames


def from_above(top: TopView, navigator, slab: int, scout, height: int) -> Image.Image:
    """The scene from straight above, `height` pixels high, with names on the robots; else as `TopView.picture`."""
    picture = Image.fromarray(top.picture(navigator, slab, scout))
    picture = picture.resize((picture.width * height // picture.height, height))
    left, right, bottom, up = top.extent
    for name, (x, y) in {"navigator": navigator[:2], "scout": scout[:2]}.items():
        at = picture.width * (x - left) / (right - left), height * (up - y) / (up - bottom)
        ImageDraw.Draw(picture).text((at[0], at[1] - 6), name, "white", anchor="mb", font=ImageFont.load_default(11))
    return picture


def captioned(picture: UInt8[np.ndarray, "h w 3"], words: str, left: int) -> UInt8[np.ndarray, "h2 w 3"]:
    """A view from above, `left` pixels wide, with two square ones beside it, under a band that says what they are."""
    canvas = Image.new("RGB", (picture.shape[1], picture.shape[0] + BAND), "white")
    canvas.paste(Image.fromarray(picture), (0, BAND))
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(13)
    for x, text in (
        (4, words),
        (left + 10, "navigator sees"),
        (left + picture.shape[0] + 16, "scout sees, and sends"),
    ):
        draw.text((x, 3), text, fill="black", font=font)
    return np.asarray(canvas)


def save_gif(
    path: Path,
    frames: Sequence[UInt8[np.ndarray, "h w 3"]],
    milliseconds: int | Sequence[int] = 80,
) -> Path:
    """Writes a looping GIF of 128 colours, the same in every frame; milliseconds are of every frame, or of each."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # Octrees split by colour, not by area: small things, such as the robots, keep theirs beside a textured picture.
    few = Image.fromarray(np.concatenate(frames)).quantize(128, method=Image.Quantize.FASTOCTREE)
    small = [Image.fromarray(frame).quantize(palette=few, dither=Image.Dither.NONE).convert("RGB") for frame in frames]
    iio.imwrite(path, [np.asarray(frame) for frame in small], duration=milliseconds, loop=0)
    return path


def film(
    layout: Layout,
    head: Result,
    content: str,
    draws: Draws,
    slab: int,
    encoder: FrozenEncoder,
    executor: FrozenExecutor,
    commit_step: int,
    path: Path,
) -> Path:
    """Films the first of some draws of the scene, under one placement of the slabs, with a head's greedy choice."""
    wire = sent_wires(layout, encoder, content, *draws, commit_step)[0, slab]
    route = int(read_head(head).policy(wire[None]).probs[0].argmax())
    take = record(layout, FastCamera(layout), encoder, executor, draws, 0, slab, route, commit_step)
    every = max(1, len(take.poses) // 40)
    return save_gif(path, pictures(layout, take, every, f"message: {content}"))
