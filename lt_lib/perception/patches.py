"""Stage 1 in the gridworld: the encoder of egocentric patches and its training (Section Encoder and freeze).

The objective is the pixel encoder's (`perception.jepa`); what differs is what is encoded, a patch of 15 x 15 cell
codes, and what the auxiliary read-out reconstructs, the code of every cell.
"""

from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn
from torch.nn import functional as F

from lt_lib.envs.gridworld import CODES, MOVES, PATCH, Grid
from lt_lib.envs.layout import SIDES, load_layout
from lt_lib.params import PatchEncoderConfig
from lt_lib.perception.encoder import LATENT, Predictor
from lt_lib.perception.jepa import Losses, class_weights, covariance_loss, variance_loss

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


class PatchJepa(nn.Module):
    """E, P, the target copy of E and the auxiliary read-out, which is discarded at the freeze."""

    def __init__(self, weights: Float[Tensor, " codes"]):
        super().__init__()
        self.encoder, self.predictor = PatchEncoder(), Predictor()
        self.target = deepcopy(self.encoder).requires_grad_(False)
        self.readout = nn.Linear(LATENT, len(weights) * PATCH * PATCH)
        self.register_buffer("class_weights", weights)

    def losses(
        self,
        patches: UInt8[Tensor, "u h w"],
        now: Int[Tensor, " b"],
        moves: Float[Tensor, "b 3"],
        following: Int[Tensor, " b"],
    ) -> Losses:
        """Of steps between rows of a table of patches; every patch is encoded once, however many steps it is in."""
        latents = self.encoder(patches)
        with torch.no_grad():
            goals = self.target(patches)
        latent, codes = latents[now], patches[now].long()
        logits = self.readout(latent).view(len(latent), -1, PATCH, PATCH)
        return Losses(
            F.mse_loss(self.predictor(latent, moves), goals[following]),
            variance_loss(latent),
            covariance_loss(latent),
            F.cross_entropy(logits, codes, weight=self.class_weights),
        )


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
    grid, rng = Grid(load_layout(config.layout)), np.random.default_rng([seed, 6])
    walk = random_walks(grid, config.frames // config.rollout, config.rollout, rng)
    rows = walk.cells * len(SIDES) + walk.slab[:, None]  # of the table of patches
    table = grid.patches.reshape(-1, PATCH, PATCH)
    patches = torch.from_numpy(table)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = PatchJepa(class_weights(table[rows[:SHARES]].astype(int), len(CODES)))
    curves = _fit(model, patches, rows, walk.actions, config, rng, report)
    with torch.no_grad():
        latents = model.encoder(patches).double()[torch.from_numpy(rows.ravel())]
    mean, std = latents.mean(0).float().numpy(), (latents.std(0) + 1e-6).float().numpy()
    weights = {
        f"{p}.{k}": v.numpy()
        for p, m in (("E", model.encoder), ("P", model.predictor))
        for k, v in m.state_dict().items()
    }
    return weights | {"mean": mean, "std": std} | curves


def _fit(model: PatchJepa, patches, rows, actions, config: PatchEncoderConfig, rng, report) -> dict:
    pairs = np.argwhere(np.ones((rows.shape[0], rows.shape[1] - 1), bool))
    updates = int(config.epochs * len(pairs) / config.batch)
    curves = np.zeros((updates, len(Losses._fields)), np.float32)
    if updates:
        optimiser = torch.optim.Adam(model.parameters(), lr=config.lr)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, config.lr, total_steps=updates + 1)
        scale = torch.tensor([config.prediction, config.variance, config.covariance, config.reconstruction])
        order = np.concatenate([rng.permutation(pairs) for _ in range(int(np.ceil(config.epochs)))])
    for update in range(updates):
        r, t = order[update * config.batch : (update + 1) * config.batch].T
        now, following = torch.from_numpy(rows[r, t]), torch.from_numpy(rows[r, t + 1])
        losses = model.losses(patches, now, displacement(actions[r, t]), following)
        stacked = torch.stack(losses)
        optimiser.zero_grad()
        (scale * stacked).sum().backward()
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            for slow, fast in zip(model.target.parameters(), model.encoder.parameters(), strict=True):
                slow.lerp_(fast, 1 - config.ema)
        curves[update] = stacked.detach()
        report((update + 1) / updates)
    return {f"loss.{name}": curves[:, i].copy() for i, name in enumerate(Losses._fields)}


def displacement(actions: Int[np.ndarray, " b"]) -> Float[Tensor, "b 3"]:
    """What P is told of an action: the move in cells, and no turn; staying is zero, as for a scout on wheels."""
    return F.pad(torch.from_numpy(MOVES[actions]).float(), (0, 1))


class FrozenPatchEncoder:
    """E and P after the freeze; the same two methods as `perception.encoder.FrozenEncoder`, for patches.

    Built from a flat mapping of arrays ("E.*", "P.*", "mean", "std").
    """

    def __init__(self, weights: Mapping[str, np.ndarray]):
        self._encoder, self._predictor = PatchEncoder(), Predictor()
        for module, prefix in ((self._encoder, "E."), (self._predictor, "P.")):
            module.load_state_dict(
                {k.removeprefix(prefix): torch.tensor(v) for k, v in weights.items() if k.startswith(prefix)}
            )
            module.requires_grad_(False)
        self._mean, self._std = torch.tensor(weights["mean"]), torch.tensor(weights["std"])

    def latent(self, patches: UInt8[np.ndarray, "b h w"]) -> Float[Tensor, "b 64"]:
        """Normalised latents of patches."""
        return (self._encoder(torch.from_numpy(patches)) - self._mean) / self._std

    def predicted(self, patches: UInt8[np.ndarray, "b h w"], move: Float[Tensor, "b 3"]) -> Float[Tensor, "b 64"]:
        """Normalised latents that P predicts for the next patch under a move (cells)."""
        raw = self._predictor(self._encoder(torch.from_numpy(patches)), move)
        return (raw - self._mean) / self._std
