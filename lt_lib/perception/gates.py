"""The freeze gates, which a checkpoint must pass before it is frozen (Section Encoder and freeze).

Linear probes test whether the content that a teammate needs is decodable; an effective rank tests whether the latent
has collapsed. All are measured on rollouts that the encoder never saw. The frames of a rollout are correlated, so the
rollout is the unit of every interval and of the split into probe training and test.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.stats import t
from sklearn.linear_model import LinearRegression, LogisticRegression
from sklearn.manifold import TSNE

from lt_lib.envs.layout import load_layout
from lt_lib.perception.encoder import LATENT, FrozenEncoder, in_chunks
from lt_lib.perception.frames import hazard_visible, random_rollouts, wall_pixels
from lt_lib.settings.base import UserError
from lt_lib.settings.perception import GateConfig, Gates
from lt_lib.settings.streams import Stream

PROBE_SHARE = 0.7  # of the held-out rollouts train the probes; the rest test them
SAMPLED = 4  # latents per rollout that are kept with the measurement


class GateError(UserError):
    """A checkpoint failed a gate; the message names the gate and the shortfall."""


class Measured(NamedTuple):
    """What `measure_gates` measures; accuracies and R^2 are those on test rollouts."""

    hazard: float  # accuracy of the linear hazard-visible probe
    hazard_low: float  # 95% Student-t interval of that accuracy over rollouts
    hazard_high: float
    majority: float  # accuracy of always guessing the more frequent answer
    walls: float  # R^2 of the linear wall-count probe
    rank: float  # exponential of the entropy of the normalised singular values of the latents
    rank_eigen: float  # the same for the eigenvalues of the covariance


def effective_rank(latent: Float[np.ndarray, "b d"], power: int = 1) -> float:
    """Exponential of the entropy of the centred latents' normalised spectrum; 0 for latents that are all equal.

    power  1: singular values; 2: eigenvalues of the covariance
    """
    centred = latent.astype(np.float64) - latent.mean(axis=0)
    spectrum = np.linalg.svd(centred, compute_uv=False) ** power  # (d,)
    if not spectrum.sum() > np.finfo(float).tiny:
        return 0.0
    share = spectrum / spectrum.sum()
    return float(np.exp(-(share * np.log(np.maximum(share, 1e-300))).sum()))


def encode(encoder: FrozenEncoder, frames: UInt8[np.ndarray, "*batch h w"]) -> Float[np.ndarray, "*batch d"]:
    """Normalised latents of frames with any leading axes."""
    return in_chunks(encoder.latent, frames.reshape(-1, *frames.shape[-2:])).reshape(*frames.shape[:-2], LATENT)


def measure_gates(
    config: GateConfig, seed: int, *, report: Callable[[float], None], encoder: Mapping[str, np.ndarray]
) -> dict:
    """Probes and rank of a checkpoint on held-out rollouts, and a t-SNE map of latents.

    Returns the fields of `Measured`, "latent.sample" (R, SAMPLED, 64) of every rollout and, for n = `config.shown`
    frames, "latent.plane" (n, 2) by t-SNE, "latent.pose" (n, 3) and "latent.hazard" (n,), whether the slab is visible.
    """
    rng = Stream.GATES.generator(seed)
    rollouts = random_rollouts(load_layout(config.layout), config.rollouts, config.length, rng)
    latents = encode(FrozenEncoder(encoder, config.device), rollouts.frames)  # (R, T, 64)
    report(0.5)
    found = probes(latents, hazard_visible(rollouts.frames), wall_pixels(rollouts.frames))
    few = np.linspace(0, latents.shape[1] - 1, min(SAMPLED, latents.shape[1])).astype(int)
    sample = {"latent.sample": latents[:, few].astype(np.float32)}
    return found._asdict() | sample | _picture(rollouts, latents, config.shown, rng)


def probes(
    latents: Float[np.ndarray, "r t 64"], visible: Bool[np.ndarray, "r t"], walls: Int[np.ndarray, "r t"]
) -> Measured:
    """Linear probes of whether the slab shows and of how many pixels are wall, fitted on some rollouts, and the rank.

    visible, walls  what the frames show, for the probes alone
    """
    cut = int(len(latents) * PROBE_SHARE)
    train, test = latents[:cut].reshape(-1, LATENT), latents[cut:].reshape(-1, LATENT)  # (frames, 64) each
    probe = LogisticRegression(max_iter=2000).fit(train, visible[:cut].ravel())
    right = (probe.predict(test) == visible[cut:].ravel()).reshape(visible[cut:].shape).mean(axis=1)  # (rollouts,)
    low, high = t.interval(0.95, len(right) - 1, loc=right.mean(), scale=right.std(ddof=1) / np.sqrt(len(right)))
    wall_probe = LinearRegression().fit(train, walls[:cut].ravel())
    commoner = visible[:cut].mean() > 0.5
    return Measured(
        float(right.mean()),
        float(low),
        float(min(high, 1.0)),
        float((visible[cut:] == commoner).mean()),
        float(wall_probe.score(test, walls[cut:].ravel())),
        effective_rank(latents.reshape(-1, LATENT)),
        effective_rank(latents.reshape(-1, LATENT), power=2),
    )


def _picture(rollouts, latents, n: int, rng: np.random.Generator) -> dict:
    frames = rollouts.frames.reshape(-1, *rollouts.frames.shape[2:])
    flat = latents.reshape(-1, LATENT)
    shown = rng.choice(len(flat), min(n, len(flat)), replace=False)
    # t-SNE, because a latent of high rank has no two principal components that stand for the rest
    plane = TSNE(perplexity=min(30, len(shown) // 4), init="pca", random_state=0).fit_transform(flat[shown])
    return {
        "latent.plane": plane,
        "latent.pose": rollouts.poses.reshape(-1, 3)[shown],
        "latent.hazard": hazard_visible(frames[shown]),
    }


def require_gates(found: Mapping[str, float], gates: Gates) -> None:
    """Raises GateError unless the checkpoint passes every preregistered gate."""
    require(
        found,
        {
            "hazard": ("linear hazard-visible probe", max(gates.hazard, found["majority"])),
            "walls": ("wall-count R^2", gates.walls),
            "rank": ("effective rank", gates.rank),
        },
    )


def passes(found: Mapping[str, float], gates: Gates) -> bool:
    """Whether a checkpoint passes every preregistered gate."""
    try:
        require_gates(found, gates)
    except GateError:
        return False
    return True


def require(found: Mapping[str, float], limits: Mapping[str, tuple[str, float]]) -> None:
    """Raises GateError, naming every value that falls short of its limit; limits are {name: (words, least value)}."""
    failed = [
        f"{words} {found[name]:.3f} is {limit - found[name]:.3f} short of {limit:.3f}"
        for name, (words, limit) in limits.items()
        if not found[name] >= limit
    ]
    if failed:
        raise GateError("not frozen: " + "; ".join(failed))
