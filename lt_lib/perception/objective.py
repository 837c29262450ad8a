"""The joint-embedding predictive objective and its optimisation, for any encoder (Section Encoder and freeze).

The loss is the weighted sum of four terms:
prediction      squared error of P(E(o_t), a_t) against the latent of o_{t+1} by the exponential-moving-average target
variance        a hinge that keeps the standard deviation of every latent dimension at 1 or above (VICReg)
covariance      squared off-diagonal covariance (VICReg)
reconstruction  class-weighted cross-entropy of a linear read-out of the latent against the observation itself, cell by
                cell, so that no label enters
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
    """The four terms of a batch before weighting, scalars."""

    prediction: Tensor
    variance: Tensor
    covariance: Tensor
    reconstruction: Tensor


def variance_loss(latent: Float[Tensor, "b d"]) -> Float[Tensor, ""]:
    """Mean over dimensions of max(0, 1 - standard deviation over the batch)."""
    return F.relu(1 - (latent.var(dim=0) + 1e-4).sqrt()).mean()


def covariance_loss(latent: Float[Tensor, "b d"]) -> Float[Tensor, ""]:
    """Sum of the squared off-diagonal entries of the covariance, divided by d."""
    centred = latent - latent.mean(dim=0)  # (B, d)
    covariance = centred.T @ centred / (len(latent) - 1)  # (d, d)
    return (covariance.square().sum() - covariance.diagonal().square().sum()) / latent.shape[1]


def class_weights(classes: Int[np.ndarray, "..."], n: int) -> Float[Tensor, " n"]:
    """Inverse square root of each class's share, scaled to a mean of 1 over the cells; 0 for classes never seen."""
    share = np.bincount(classes.ravel(), minlength=n) / classes.size  # (n,)
    weights = np.where(share > 0, 1 / np.sqrt(np.maximum(share, 1e-9)), 0)
    return torch.tensor(weights / (weights * share).sum(), dtype=torch.float32)


class Jepa(nn.Module):
    """E, P, the target copy of E, and the auxiliary read-out, which the freeze discards."""

    def __init__(self, encoder: nn.Module, weights: Float[Tensor, " classes"], side: int):
        """weights: (classes,) of the classes that the read-out distinguishes in each of `side` x `side` cells."""
        super().__init__()
        self.encoder, self.predictor = encoder, Predictor()
        self.target = deepcopy(self.encoder).requires_grad_(False)
        self.readout = nn.Linear(LATENT, len(weights) * side * side)
        self.register_buffer("class_weights", weights)

    @torch.no_grad()
    def goal(self, following: Tensor) -> Float[Tensor, "b 64"]:
        """The target's latents of the next observations, without gradient."""
        return self.target(following)

    def losses(
        self,
        latent: Float[Tensor, "b 64"],
        actions: Float[Tensor, "b 3"],
        goal: Float[Tensor, "b 64"],
        classes: Int[Tensor, "b g g"],
    ) -> Losses:
        """Losses of B steps from E's latents to the target's.

        actions  taken at the first observation
        goal     the target's latents of the second observation
        classes  of the cells of the first observation, G x G of them
        """
        logits = self.readout(latent).unflatten(1, (-1, *classes.shape[1:]))  # (B, classes, G, G)
        return Losses(
            F.mse_loss(self.predictor(latent, actions), goal),
            variance_loss(latent),
            covariance_loss(latent),
            F.cross_entropy(logits, classes, weight=self.class_weights),
        )

    @torch.no_grad()
    def follow(self, decay: float):
        """Moves the target towards E: target = decay * target + (1 - decay) * E."""
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
    """Trains a `Jepa` as `optimise` does; returns "loss.*" (updates,), each term before weighting.

    losses  maps rollouts r (B,) and times t (B,) to the losses of the steps from t to t + 1
    """
    scale = torch.tensor([config.prediction, config.variance, config.covariance, config.reconstruction])

    def terms(r: Int[np.ndarray, " b"], t: Int[np.ndarray, " b"]) -> Float[Tensor, "4"]:
        return torch.stack(losses(r, t))

    scale = scale.to(model.class_weights.device)
    curves = optimise(model, terms, scale, rollouts, config, rng, report, lambda: model.follow(config.ema))
    return {f"loss.{name}": curves[:, i].copy() for i, name in enumerate(Losses._fields)}


def optimise(
    model: nn.Module,
    terms: Callable[[Int[np.ndarray, " b"], Int[np.ndarray, " b"]], Float[Tensor, " k"]],
    scale: Float[Tensor, " k"],
    rollouts: tuple[int, int],
    config: ObjectiveConfig,
    rng: np.random.Generator,
    report: Callable[[float], None],
    after: Callable[[], None] = lambda: None,
) -> Float[np.ndarray, "updates k"]:
    """Trains with Adam and a one-cycle rate on every step of the rollouts in random order; returns the terms' curves.

    terms     maps rollouts r (B,) and times t (B,) to the terms of the loss, which `scale` weights; there is always a
              frame t + 1
    rollouts  number and length of the rollouts
    report    receives the share of updates done
    after     is called after every update
    """
    number, length = rollouts
    steps = np.argwhere(np.ones((number, length - 1), bool))  # (steps, 2): rollout, time
    updates = int(config.epochs * len(steps) / config.batch)
    curves = np.zeros((updates, len(scale)), np.float32)
    if updates:
        optimiser = torch.optim.Adam(model.parameters(), lr=config.lr)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, config.lr, total_steps=updates + 1)
        order = np.concatenate([rng.permutation(steps) for _ in range(int(np.ceil(config.epochs)))])  # (*, 2)
    for update in range(updates):
        r, t = order[update * config.batch : (update + 1) * config.batch].T  # (B,) each
        each = terms(r, t)
        optimiser.zero_grad()
        (scale * each).sum().backward()
        optimiser.step()
        schedule.step()
        after()
        curves[update] = each.detach().cpu()
        report((update + 1) / updates)
    return curves


def frozen(model: Jepa, latents: Float[np.ndarray, "n 64"]) -> dict[str, np.ndarray]:
    """The arrays kept at the freeze: weights "E.*" and "P.*", and the normalisation "mean", "std" (64,).

    latents  E's raw latents of the training frames
    """
    return state_of(model.encoder, "E") | state_of(model.predictor, "P") | normalisation(latents)


def normalisation(latents: Float[np.ndarray, "n 64"]) -> dict[str, np.ndarray]:
    """ "mean" and "std" (64,) of latents, by which frozen latents are standardised."""
    latents = latents.astype(np.float64)
    std = latents.std(axis=0, ddof=1) + 1e-6
    return {"mean": latents.mean(axis=0).astype(np.float32), "std": std.astype(np.float32)}
