"""One draw of the scene twice, side by side as plans: with the message, and with nothing in its place."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from lt_lib.envs.arena import CONTROL_HZ, HORIZON
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import Layout
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.pixels.episodes import Draws
from lt_lib.pixels.executor import FrozenExecutor
from lt_lib.pixels.film import Take, record, save_gif
from lt_lib.pixels.route import read_head, sent_wires
from lt_lib.report import scene
from lt_lib.store.run import Result

PACE, MOST = 4, 50  # control steps from one picture to the next at least; pictures of the drive at most
FIRST, EACH, LAST = 2_000, 90, 4_000  # milliseconds that pictures stay
SIZE, DPI = (9.6, 2.9), 90  # inches


def film_pair(
    layout: Layout,
    heads: Mapping[str, Sequence[Result]],
    bank: Result,
    encoder: Result,
    executor: Result,
    commit_step: int,
    path: Path,
) -> Path:
    """Films the first held-out draw with the first latent head and with the first floor head, both greedy.

    The slab is in the corridor that the floor's head prefers, so that the pair shows what the message contributes.
    """
    frozen, driver = FrozenEncoder(encoder), FrozenExecutor(executor)
    draws = Draws(bank["spawn"][:1], bank["scout"][:1])
    chosen = {name: read_head(heads[name][0]).policy for name in ("latent", "floor")}
    wires = {name: sent_wires(layout, frozen, name, *draws, commit_step)[0] for name in chosen}
    slab = int(chosen["floor"](wires["floor"][:1]).probs[0].argmax())
    takes = {}
    for name, words in (("latent", "the scout sends its latent"), ("floor", "the scout sends nothing")):
        route = int(chosen[name](wires[name][slab][None]).probs[0].argmax())
        takes[words] = record(layout, FastCamera(layout), frozen, driver, draws, 0, slab, route, commit_step)
    return save_pair(layout, takes, commit_step, path)


def save_pair(layout: Layout, takes: Mapping[str, Take], commit_step: int, path: Path) -> Path:
    """Writes the film: the moment of the choice is held, then both drive, and the last picture says how each ends."""
    ends = [len(take.poses) - 1 for take in takes.values()]
    pace = max(PACE, -(-min(ends) // MOST))
    steps = [commit_step, *range(pace, min(ends), pace), max(ends)]
    frames = [_picture(layout, takes, step, commit_step) for step in steps]
    return save_gif(path, frames, [FIRST, *[EACH] * (len(steps) - 2), LAST])


def _picture(layout: Layout, takes: Mapping[str, Take], step: int, commit_step: int) -> UInt8[np.ndarray, "h w 3"]:
    figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
    for axes, (words, take) in zip(figure.subplots(1, len(takes)), takes.items(), strict=True):
        _plan(axes, layout, take, min(step, len(take.poses) - 1))
        if step <= commit_step:
            _message(axes, take, words)
        axes.set_title(f"{words}\n{_said(layout, take, step, commit_step)}", fontsize=12)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _said(layout: Layout, take: Take, step: int, commit_step: int) -> str:
    """What happens at a step, in words."""
    end, side = len(take.poses) - 1, layout.sides[take.route]
    if step <= commit_step:
        return f"{step / CONTROL_HZ:.1f} s: the navigator chooses the {side} corridor"
    if step >= end:
        return (
            f"goal after {end / CONTROL_HZ:.0f} s"
            if end < HORIZON
            else f"stuck: time-out after {end / CONTROL_HZ:.0f} s"
        )
    return f"{step / CONTROL_HZ:.0f} s, {side} corridor"


def _plan(axes: Axes, layout: Layout, take: Take, step: int) -> None:
    """The plan with both robots, the way so far, and what is what."""
    scene.plan(axes, layout, take.slab)
    x, y, heading = take.poses[step]
    axes.plot(*take.poses[: step + 1, :2].T, "-", color=scene.NAVIGATOR, lw=2)
    for place, colour, words in (((x, y), scene.NAVIGATOR, "navigator"), (take.scout[:2], scene.SCOUT, "scout")):
        axes.add_patch(Circle(place, 1.6 * layout.robot.radius, color=colour, ec="black", lw=0.8, zorder=4))
        axes.annotate(words, place, (0, -20), textcoords="offset points", ha="center", fontsize=10, color="black")
    axes.plot([x, x + 0.35 * np.cos(heading)], [y, y + 0.35 * np.sin(heading)], color="black", lw=1.5, zorder=5)
    axes.annotate("slab", layout.slab(take.slab).centre, ha="center", va="center", fontsize=8, color="white")
    for side, route in zip(layout.sides, layout.routes, strict=True):
        mouth = route.legs[0]
        axes.annotate(f"{side}", (mouth.x[0] + 0.1, sum(mouth.y) / 2), fontsize=9, va="center", color="black")
    axes.set(xlabel="", ylabel="", xticks=[], yticks=[])


def _message(axes: Axes, take: Take, words: str) -> None:
    """The message on its way, before both robots drive."""
    arrow = {"arrowstyle": "->", "ls": "--", "lw": 2, "color": scene.SCOUT}
    axes.annotate("", take.poses[0, :2] + [0.4, 0.1], take.scout[:2] - [0.4, -0.1], arrowprops=arrow, zorder=6)
    box = {"boxstyle": "round", "fc": "white", "ec": scene.SCOUT}
    middle = (take.poses[0, :2] + take.scout[:2]) / 2
    axes.annotate(words.split("sends ")[1], middle, ha="center", va="center", fontsize=10, bbox=box, zorder=7)
