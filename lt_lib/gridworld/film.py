"""GIF of one gridworld episode: the map, both fields of view, and what the message changes."""

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lt_lib.envs.layout import SIDES
from lt_lib.gridworld.board import board, patch
from lt_lib.gridworld.episodes import read_actor
from lt_lib.gridworld.map import Grid
from lt_lib.gridworld.mappo import Actor, Inputs
from lt_lib.gridworld.views import cells
from lt_lib.report.scene import NAVIGATOR, SCOUT
from lt_lib.report.style import ROLES
from lt_lib.store.run import Result

LONGEST = 14  # pictures; a solved episode takes about 12
STEP_MS = 650  # on the screen; twice as long where the message changes what is done
ARROWS = ("stay", "right", "left", "up", "down")  # on the map


def film(grid: Grid, policy: Result, encoder: Result, content: str, start: int, slab: int, path: Path) -> Path:
    """Films a greedy episode from a spawn cell with the slab in one corridor; one picture per step."""
    inputs, actor = Inputs.of(grid, cells(grid, encoder), content), read_actor(policy)
    cell, pictures, held = start, [], []
    for step in range(LONGEST):
        message = 0 if step == 0 else 1 + len(grid.posts) // 2
        row = torch.tensor([[message, cell, slab]])
        told, untold = (_decide(inputs, actor, row, loudness) for loudness in (1.0, 0.0))
        decides = told.argmax() != untold.argmax()  # without the message's content another action would be likeliest
        pictures.append(_picture(grid, cell, slab, step, told, untold, decides))
        held.append(2 * STEP_MS if decides else STEP_MS)
        if grid.goal[cell] or grid.slab[slab, cell]:
            break
        cell = int(grid.following[cell, told.argmax()])
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, pictures, duration=[*held[:-1], 3 * STEP_MS], loop=0)
    return path


@torch.no_grad()
def _decide(inputs: Inputs, actor: Actor, row, loudness: float) -> Float[np.ndarray, "5"]:
    """Action probabilities with the message's content scaled by `loudness`."""
    message, cell, slab = row.unbind(1)
    wires, present = inputs.wires(row)[:, None].clone(), inputs.present[message, cell][:, None]
    wires[..., inputs.anchors.shape[-1] :] *= loudness
    return actor(inputs.own[cell, slab], wires, present).softmax(1)[0].numpy()


def _picture(grid: Grid, cell: int, slab: int, step: int, told, untold, decides) -> UInt8[np.ndarray, "h w 3"]:
    figure = Figure(figsize=(10, 3.3), dpi=80, layout="constrained")
    above, sees, sends, acts = figure.subplots(1, 4, width_ratios=(1.7, 1, 1, 1.1))
    post = grid.posts[len(grid.posts) // 2]
    board(above, grid, slab)
    above.plot(*grid.centres[cell], "o", color=NAVIGATOR, ms=10, mec="white")
    above.plot(*grid.centres[post], "s", color=SCOUT, ms=9, mec="white")
    above.set_title(f"step {step}: slab {SIDES[slab]}", fontsize=12)
    patch(sees, grid.patches[cell, slab], NAVIGATOR, "navigator sees")
    patch(sends, grid.patches[post, slab], SCOUT, "scout sees, and sends")
    places = np.arange(len(ARROWS))
    acts.barh(places + 0.2, told, 0.38, color=ROLES["ours"], label="told")
    acts.barh(places - 0.2, untold, 0.38, color="0.75", label="not told")
    acts.set_yticks(places, ARROWS, fontsize=10)
    acts.set(xlim=(0, 1.02))
    acts.invert_yaxis()
    acts.legend(fontsize=10, loc="upper center", bbox_to_anchor=(0.4, -0.12), ncols=2)
    words, colour = ("the message decides", "#B22222") if decides else ("the message changes nothing", "0.3")
    acts.set_title(words, color=colour)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
