"""The joint-embedding predictive objective and its optimisation, for any encoder (Section Encoder and freeze).

loss = prediction + variance + covariance + reconstruction, each with its weight:
prediction      P(E(o_t), a_t) against the exponential-moving-average target's latent of o_{t+1}
variance        hinge that keeps every latent dimension's standard deviation at 1 or above (VICReg)
covariance      squared off-diagonal covariance (VICReg)
reconstruction  class-weighted cross-entropy of a linear read-out of the latent against the observation itself, cell
                by cell: no label enters
"""

from collections.abc import Callable
from copy import deepcopy
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from lt_lib.perception.encoder import LATENT, Predictor
from lt_lib.settings.perception import ObjectiveConfig
from lt_lib.store.states import state_of


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


def class_weights(classes: Int[np.ndarray, "..."], n: int) -> Float[Tensor, " n"]:
    """One over the square root of a class's share, scaled to a mean of 1 over the cells; 0 for a class never seen."""
    share = np.bincount(classes.ravel(), minlength=n) / classes.size
    weights = np.where(share > 0, 1 / np.sqrt(np.maximum(share, 1e-9)), 0)
    return torch.tensor(weights / (weights * share).sum(), dtype=torch.float32)


class Jepa(nn.Module):
    """E, P, the target copy of E and the auxiliary read-out, which is discarded at the freeze."""

    def __init__(self, encoder: nn.Module, weights: Float[Tensor, " classes"], side: int):
        """weights: of the classes that the read-out tells apart in each of `side` x `side` cells."""
        super().__init__()
        self.encoder, self.predictor = encoder, Predictor()
        self.target = deepcopy(self.encoder).requires_grad_(False)
        self.readout = nn.Linear(LATENT, len(weights) * side * side)
        self.register_buffer("class_weights", weights)

    @torch.no_grad()
    def goal(self, following: Tensor) -> Float[Tensor, "b 64"]:
        """The target's latents, which get no gradient."""
        return self.target(following)

    def losses(
        self,
        latent: Float[Tensor, "b 64"],
        actions: Float[Tensor, "b 3"],
        goal: Float[Tensor, "b 64"],
        classes: Int[Tensor, "b g g"],
    ) -> Losses:
        """Of steps from E's latents to the target's; classes are those of the first observation's cells."""
        logits = self.readout(latent).unflatten(1, (-1, *classes.shape[1:]))
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


def fit(
    model: Jepa,
    losses: Callable[[Int[np.ndarray, " b"], Int[np.ndarray, " b"]], Losses],
    rollouts: tuple[int, int],
    config: ObjectiveConfig,
    rng: np.random.Generator,
    report: Callable[[float], None],
) -> dict[str, np.ndarray]:
    """Adam with a one-cycle rate over every step of the rollouts in random order; returns "loss.*" (updates,).

    losses    of a batch: of the steps from time t to t + 1 in the rollouts r, called with (r, t)
    rollouts  their number and length
    """
    number, length = rollouts
    steps = np.argwhere(np.ones((number, length - 1), bool))
    updates = int(config.epochs * len(steps) / config.batch)
    curves = np.zeros((updates, len(Losses._fields)), np.float32)
    if updates:
        optimiser = torch.optim.Adam(model.parameters(), lr=config.lr)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, config.lr, total_steps=updates + 1)
        order = np.concatenate([rng.permutation(steps) for _ in range(int(np.ceil(config.epochs)))])
    scale = torch.tensor([config.prediction, config.variance, config.covariance, config.reconstruction])
    scale = scale.to(model.class_weights.device)
    for update in range(updates):
        r, t = order[update * config.batch : (update + 1) * config.batch].T
        terms = torch.stack(losses(r, t))
        optimiser.zero_grad()
        (scale * terms).sum().backward()
        optimiser.step()
        schedule.step()
        model.follow(config.ema)
        curves[update] = terms.detach().cpu()
        report((update + 1) / updates)
    return {f"loss.{name}": curves[:, i].copy() for i, name in enumerate(Losses._fields)}


def frozen(model: Jepa, latents: Float[np.ndarray, "n 64"]) -> dict[str, np.ndarray]:
    """What is kept of E and P: weights "E.*" and "P.*", and "mean", "std" (64,) of E's latents of training frames."""
    latents = latents.astype(np.float64)
    weights = state_of(model.encoder, "E") | state_of(model.predictor, "P")
    std = latents.std(axis=0, ddof=1) + 1e-6
    return weights | {"mean": latents.mean(axis=0).astype(np.float32), "std": std.astype(np.float32)}
