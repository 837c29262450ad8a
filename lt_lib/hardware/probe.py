"""The hazard probe and what is measured with it (Section Hardware): 64 weights and a threshold on the frozen latent."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import balanced_accuracy_score, roc_auc_score

from lt_lib.hardware.sessions import Session
from lt_lib.perception.pictures import PictureEncoder


class Probe(NamedTuple):
    """A linear read-out; positive scores say 'hazard'."""

    weights: Float[np.ndarray, " d"]
    bias: float

    @property
    def parameters(self) -> int:
        return self.weights.size + 1

    def scores(self, latents: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        return latents @ self.weights + self.bias


def fit_probe(latents: Float[np.ndarray, "n d"], hazard: Bool[np.ndarray, " n"]) -> Probe:
    """Logistic regression, both classes weighing the same, scikit-learn's default penalty (C = 1)."""
    fitted = LogisticRegression(class_weight="balanced", max_iter=5000).fit(latents, hazard)
    return Probe(fitted.coef_[0], float(fitted.intercept_[0]))


class Decoded(NamedTuple):
    """How well scores tell hazard from clear."""

    auc: float  # of the direction, whatever the threshold
    balanced: float  # accuracy at the threshold 0, mean of the two classes


def decoded(scores: Float[np.ndarray, " n"], hazard: Bool[np.ndarray, " n"]) -> Decoded:
    return Decoded(float(roc_auc_score(hazard, scores)), float(balanced_accuracy_score(hazard, scores > 0)))


class CameraTransfer(NamedTuple):
    """One encoder's way from simulation to the camera."""

    simulated: Probe  # fitted on simulated latents
    refit: Probe  # fitted on the camera's refit session
    latents: dict[str, Float[np.ndarray, "n 64"]]  # by session, "simulated" among them
    hazard: dict[str, Bool[np.ndarray, " n"]]

    def decoded(self, probe: Probe, session: str) -> Decoded:
        return decoded(probe.scores(self.latents[session]), self.hazard[session])

    def registered(self, gate: float) -> Probe:
        """The probe that the registered rule keeps: the simulated one unless it misses the gate when refit."""
        return self.simulated if self.decoded(self.simulated, "refit").balanced >= gate else self.refit

    def right(self, probe: Probe, session: str) -> Bool[np.ndarray, " n"]:
        """Which decisions a probe gets right."""
        return (probe.scores(self.latents[session]) > 0) == self.hazard[session]


def transfer(encoder: PictureEncoder, simulated: Session, sessions: Mapping[str, Session]) -> CameraTransfer:
    """Fits both probes of an encoder; the validation and live sessions are encoded and nothing more."""
    everything = {"simulated": simulated, **sessions}
    latents = {name: encoder.latents(session.frames) for name, session in everything.items()}
    hazard = {name: session.hazard for name, session in everything.items()}
    probes = (fit_probe(latents[name], hazard[name]) for name in ("simulated", "refit"))
    return CameraTransfer(*probes, latents, hazard)


def placements_right(right: Bool[np.ndarray, " n"], placement) -> tuple[int, int]:
    """How many placements had every one of their decisions right, and how many placements there are."""
    names = np.unique(placement)
    return int(sum(right[placement == name].all() for name in names)), len(names)


def red_shares(frames: UInt8[np.ndarray, "n h w 3"], ratio: float) -> Float[np.ndarray, " n"]:
    """Share of a frame's pixels whose red is more than `ratio` times the larger of green and blue."""
    red, others = frames[..., 0].astype(float), frames[..., 1:].max(-1).astype(float)
    return (red > ratio * others).mean(axis=(1, 2))


def frechet(one: Float[np.ndarray, "n d"], other: Float[np.ndarray, "m d"]) -> float:
    """Frechet distance between normal distributions with the moments of two samples of latents.

    It is biased upwards where n or m is not much larger than d: compare it with that of two samples of one kind and
    of the same sizes.
    """
    gap = one.mean(0) - other.mean(0)
    a, b = np.cov(one, rowvar=False), np.cov(other, rowvar=False)
    values, vectors = np.linalg.eigh(a)
    half = (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T  # the square root of a
    cross = np.sqrt(np.maximum(np.linalg.eigvalsh(half @ b @ half), 0)).sum()  # the trace of (a b)^(1/2)
    return float(gap @ gap + np.trace(a) + np.trace(b) - 2 * cross)
