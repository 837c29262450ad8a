"""The joint-embedding predictive objective and its training (Section Encoder and freeze).

loss = prediction + variance + covariance + reconstruction, each with its weight:
prediction      P(E(o_t), a_t) against the exponential-moving-average target's latent of o_{t+1}
variance        hinge that keeps every latent dimension's standard deviation at 1 or above (VICReg)
covariance      squared off-diagonal covariance (VICReg)
reconstruction  class-weighted cross-entropy of a linear read-out of the latent against the frame itself, coarse in
                space, its classes the frame's own quantised colours: no label enters
"""

from collections.abc import Callable
from copy import deepcopy
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from lt_lib.envs.camera import network_input
from lt_lib.envs.layout import load_layout
from lt_lib.envs.materials import PALETTE
from lt_lib.params import EncoderConfig
from lt_lib.perception.encoder import LATENT, Encoder, Predictor, best_device
from lt_lib.perception.frames import random_rollouts

LEVELS = 4  # quantised levels a colour channel
GRID = 16  # cells a side of the reconstructed frame


class Losses(NamedTuple):
    prediction: Tensor
    variance: Tensor
    covariance: Tensor
    reconstruction: Tensor


def variance_loss(latent: Float[Tensor, "b d"]) -> Float[Tensor, ""]:
    """Mean over dimensions of max(0, 1 - standard deviation)."""
    return F.relu(1 - (latent.var(dim=0) + 1e-4).sqrt()).mean()


def covariance_loss(latent: Float[Tensor, "b d"]) -> Float[Tensor, ""]:
    """Sum of the squared off-diagonal entries of the covariance, over d."""
    centred = latent - latent.mean(dim=0)
    covariance = centred.T @ centred / (len(latent) - 1)  # (d, d)
    return (covariance.square().sum() - covariance.diagonal().square().sum()) / latent.shape[1]


def colour_classes() -> Int[np.ndarray, " colours"]:
    """The class of each palette entry: its colour quantised to LEVELS a channel, equal codes sharing a class."""
    codes = PALETTE.astype(int) * LEVELS // 256 @ np.array([LEVELS**2, LEVELS, 1])
    return np.unique(codes, return_inverse=True)[1]


def class_weights(classes: Int[np.ndarray, "..."], n: int) -> Float[Tensor, " n"]:
    """One over the square root of a class's share, scaled to a mean of 1 over the pixels; 0 for a class never seen."""
    share = np.bincount(classes.ravel(), minlength=n) / classes.size
    weights = np.where(share > 0, 1 / np.sqrt(np.maximum(share, 1e-9)), 0)
    return torch.tensor(weights / (weights * share).sum(), dtype=torch.float32)


class Jepa(nn.Module):
    """E, P, the target copy of E and the auxiliary read-out, which is discarded at the freeze."""

    def __init__(self, weights: Float[Tensor, " classes"]):
        super().__init__()
        self.encoder, self.predictor = Encoder(), Predictor()
        self.target = deepcopy(self.encoder).requires_grad_(False)
        self.readout = nn.Linear(LATENT, len(weights) * GRID * GRID)
        self.register_buffer("class_weights", weights)

    def losses(
        self,
        frames: Float[Tensor, "b h w 3"],
        actions: Float[Tensor, "b 3"],
        following: Float[Tensor, "b h w 3"],
        classes: Int[Tensor, "b g g"],
    ) -> Losses:
        latent = self.encoder(frames)
        with torch.no_grad():
            goal = self.target(following)
        logits = self.readout(latent).view(len(latent), -1, GRID, GRID)
        return Losses(
            F.mse_loss(self.predictor(latent, actions), goal),
            variance_loss(latent),
            covariance_loss(latent),
            F.cross_entropy(logits, classes, weight=self.class_weights),
        )

    @torch.no_grad()
    def follow(self, decay: float):
        """The target moves towards E: target = decay * target + (1 - decay) * E."""
        for slow, fast in zip(self.target.parameters(), self.encoder.parameters(), strict=True):
            slow.lerp_(fast, 1 - decay)


def train_encoder(config: EncoderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """Trains E and P on random rollouts; returns weights, the normalisation and the loss curves.

    "E.*", "P.*"  weights;  "mean", "std" (64,) of the latent over the training frames
    "loss.*"      (updates,) each term before weighting
    """
    rng = np.random.default_rng([seed, 0])
    rollouts = random_rollouts(load_layout(config.layout), config.frames // config.rollout, config.rollout, rng)
    classes = colour_classes()
    device = best_device(config.device)
    cells = _cells(rollouts.frames)
    with torch.random.fork_rng(devices=[]):  # module initialisation draws from torch's global generator
        torch.manual_seed(seed)
        model = Jepa(class_weights(classes[cells], int(classes.max()) + 1)).to(device)
    curves = _fit(model, rollouts, torch.from_numpy(classes)[torch.from_numpy(cells).long()], config, rng, report)
    mean, std = _moments(model.encoder, rollouts.frames, device)
    weights = {
        f"{p}.{k}": v.cpu().numpy()
        for p, m in (("E", model.encoder), ("P", model.predictor))
        for k, v in m.state_dict().items()
    }
    return weights | {"mean": mean, "std": std} | curves


def _cells(frames):
    """The frame sampled at the centre of each of GRID x GRID cells, (..., GRID, GRID)."""
    step = frames.shape[-1] // GRID
    return frames[..., step // 2 :: step, step // 2 :: step]


def _fit(model: Jepa, rollouts, classes, config: EncoderConfig, rng: np.random.Generator, report) -> dict:
    frames, actions = rollouts.frames, torch.from_numpy(rollouts.actions)
    device = model.class_weights.device
    pairs = np.stack(
        np.meshgrid(np.arange(frames.shape[0]), np.arange(frames.shape[1] - 1), indexing="ij"), -1
    ).reshape(-1, 2)
    updates = int(config.epochs * len(pairs) / config.batch)
    curves = np.zeros((updates, len(Losses._fields)), np.float32)
    if updates == 0:
        return _named(curves)
    optimiser = torch.optim.Adam(model.parameters(), lr=config.lr)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, config.lr, total_steps=updates + 1)
    scale = torch.tensor([config.prediction, config.variance, config.covariance, config.reconstruction], device=device)
    order = np.concatenate([rng.permutation(pairs) for _ in range(int(np.ceil(config.epochs)))])
    for update in range(updates):
        r, t = order[update * config.batch : (update + 1) * config.batch].T
        now, following = (torch.from_numpy(network_input(frames[r, t + k])).to(device) for k in (0, 1))
        losses = model.losses(now, actions[r, t].to(device), following, classes[r, t].to(device))
        stacked = torch.stack(losses)
        optimiser.zero_grad()
        (scale * stacked).sum().backward()
        optimiser.step()
        schedule.step()
        model.follow(config.ema)
        curves[update] = stacked.detach().cpu()
        report((update + 1) / updates)
    return _named(curves)


def _named(curves) -> dict:
    return {f"loss.{name}": curves[:, i].copy() for i, name in enumerate(Losses._fields)}


@torch.no_grad()
def _moments(encoder: Encoder, frames, device, chunk: int = 1024):
    """Mean and standard deviation of the latent over all training frames, (64,) each."""
    flat = frames.reshape(-1, *frames.shape[2:])
    latents = [
        encoder(torch.from_numpy(network_input(flat[i : i + chunk])).to(device)).cpu()
        for i in range(0, len(flat), chunk)
    ]
    latents = torch.cat(latents).double()
    return latents.mean(0).float().numpy(), (latents.std(0) + 1e-6).float().numpy()
