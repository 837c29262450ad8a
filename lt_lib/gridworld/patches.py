"""Stage 1 in the gridworld: the encoder of egocentric patches and its training (Section Encoder and freeze).

The objective is the pixel encoder's (`perception.objective`); what differs is what is encoded, a patch of 15 x 15 cell
codes, and what the auxiliary read-out reconstructs, the code of every cell.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn
from torch.nn import functional as F

from lt_lib.envs.layout import SIDES, load_layout
from lt_lib.gridworld.map import CODES, MOVES, PATCH, Grid
from lt_lib.perception.encoder import LATENT, Frozen
from lt_lib.perception.objective import Jepa, Losses, class_weights, fit, frozen
from lt_lib.settings.gridworld import PatchEncoderConfig
from lt_lib.settings.streams import Stream

SHARES = 1_000  # walks whose views tell how common each code is


class PatchEncoder(nn.Module):
    """Cell codes (B, 15, 15) to raw latents (B, 64)."""

    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(len(CODES), 32, kernel_size=3, stride=2),
            nn.ReLU(),  # (B, 32, 7, 7)
            nn.Conv2d(32, 64, kernel_size=3, stride=2),
            nn.ReLU(),  # (B, 64, 3, 3)
            nn.Flatten(),
            nn.Linear(576, LATENT),
        )

    def forward(self, patches: UInt8[Tensor, "b h w"]) -> Float[Tensor, "b 64"]:
        return self.layers(F.one_hot(patches.long(), len(CODES)).permute(0, 3, 1, 2).float())


class PatchProjection(nn.Module):
    """A linear map of the one-hot cells of patches (B, 15, 15) to raw latents (B, 64)."""

    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(PATCH * PATCH * len(CODES), LATENT)

    def forward(self, patches: UInt8[Tensor, "b h w"]) -> Float[Tensor, "b 64"]:
        return self.linear(F.one_hot(patches.long(), len(CODES)).float().flatten(1))


class Walk(NamedTuple):
    """Random rollouts: cells (R, T), the slab's corridor (R,), the action taken in each cell (R, T)."""

    cells: Int[np.ndarray, "r t"]
    slab: Int[np.ndarray, " r"]
    actions: Int[np.ndarray, "r t"]


def random_walks(grid: Grid, n: int, length: int, rng: np.random.Generator) -> Walk:
    """n walks from uniform free cells with uniform actions; the slab is as solid as a wall."""
    slab, actions = rng.integers(0, len(SIDES), n), rng.integers(0, len(MOVES), (n, length))
    starts = [np.flatnonzero(~blocked) for blocked in grid.slab]
    cells = np.empty((n, length), int)
    cells[:, 0] = np.select([slab == side for side in range(len(SIDES))], [rng.choice(s, n) for s in starts])
    for t in range(1, length):
        there = grid.following[cells[:, t - 1], actions[:, t - 1]]
        cells[:, t] = np.where(grid.slab[slab, there], cells[:, t - 1], there)
    return Walk(cells, slab, actions)


def train_patch_encoder(config: PatchEncoderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """Trains E and P on random walks; returns weights, the normalisation and the loss curves.

    "E.*", "P.*"  weights;  "mean", "std" (64,) of the latent over the training patches
    "loss.*"      (updates,) each term before weighting
    """
    grid, rng = Grid(load_layout(config.layout)), Stream.PATCH_ENCODER.generator(seed)
    walk = random_walks(grid, config.frames // config.rollout, config.rollout, rng)
    rows = walk.cells * len(SIDES) + walk.slab[:, None]  # of the table of patches
    table = grid.patches.reshape(-1, PATCH, PATCH)
    patches = torch.from_numpy(table)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = Jepa(PatchEncoder(), class_weights(table[rows[:SHARES]].astype(int), len(CODES)), PATCH)

    def losses(r: Int[np.ndarray, " b"], t: Int[np.ndarray, " b"]) -> Losses:
        now, following = rows[r, t], rows[r, t + 1]
        latents, goals = model.encoder(patches), model.goal(patches)  # each once, however many steps it is in
        return model.losses(latents[now], displacement(walk.actions[r, t]), goals[following], patches[now].long())

    curves = fit(model, losses, rows.shape, config, rng, report)
    with torch.no_grad():
        latents = model.encoder(patches).numpy()
    return frozen(model, latents[rows.ravel()]) | curves


def displacement(actions: Int[np.ndarray, " b"]) -> Float[Tensor, "b 3"]:
    """What P is told of an action: the move in cells, and no turn; staying is zero, as for a scout on wheels."""
    return F.pad(torch.from_numpy(MOVES[actions]).float(), (0, 1))


class FrozenPatchEncoder(Frozen):
    """For patches (B, 15, 15) of cell codes: of the encoder, or of a projection, as the weights say; CPU, float32."""

    def __init__(self, weights: Mapping[str, np.ndarray]):
        network = PatchProjection() if "E.linear.weight" in weights else PatchEncoder()
        super().__init__(network, weights, "cpu", "float32")

    def inputs(self, observations: UInt8[np.ndarray, "b h w"]) -> UInt8[Tensor, "b h w"]:
        return torch.from_numpy(observations)
