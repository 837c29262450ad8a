"""Fits of the share of solved runs against z: one sigmoid, one for each window length, and their comparison.

The settings are a fixed design and the seeds of each are independent draws, so intervals resample seeds.

z (S,) of the settings, solved (S,) counts out of n seeds each, group (S,) index of the window length.
"""

from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import stats
from scipy.optimize import minimize
from scipy.special import expit, log_expit

STEPS = 50  # widths on the grid
WIDTHS = (0.02, 20.0)  # of the sigmoid; without a lower bound it has no fit where one z separates the outcomes
Z, Counts = Float[np.ndarray, " s"], Int[np.ndarray, " s"]


def fit(z: Z, solved: Counts, n: int) -> tuple[float, float]:
    """Centre and width of the likeliest sigmoid, seeds binomial."""
    centre, log_width = _likeliest(partial(_binomial, z, np.zeros(len(z), int), solved, n), z, 1).x
    return float(centre), float(np.exp(log_width))


@lru_cache(maxsize=8)
def _grid(z: bytes) -> tuple[Float[np.ndarray, "c w 2"], Float[np.ndarray, "c w s"], Float[np.ndarray, "c w s"]]:
    """Sigmoids (centres 0.05 apart), and per setting the log-probability of a solved and of an unsolved run.

    Every resample of a design asks for the same ones.
    """
    settings = np.frombuffer(z)
    centres, widths = np.arange(settings.min(), settings.max() + 0.05, 0.05), np.geomspace(*WIDTHS, STEPS)
    grid = np.stack(np.meshgrid(centres, widths, indexing="ij"), -1)
    logit = (grid[..., :1] - settings) / grid[..., 1:]
    return grid, log_expit(logit), log_expit(-logit)


def likelihoods(
    z: Z, solved: Int[np.ndarray, "s ..."], n: int | Int[np.ndarray, " s"]
) -> tuple[Float[np.ndarray, "c w 2"], Float[np.ndarray, "c w ..."]]:
    """Sigmoids on a grid of centres and widths, and the log-likelihood of each, seeds binomial."""
    grid, yes, no = _grid(np.ascontiguousarray(z, float).tobytes())
    return grid, yes @ solved + no @ (n - solved)


def bootstrap(z: Z, solved: Counts, n: int, repeats: int, rng: np.random.Generator) -> Float[np.ndarray, "b 2"]:
    """Centre and width over resampled seeds, each the likeliest on a grid of sigmoids.

    The settings are a design, not a sample, so each keeps its place and its seeds are drawn anew (binomial).
    """
    drawn = rng.binomial(n, solved / n, (repeats, len(z)))  # (b, s)
    grid, loglik = likelihoods(z, drawn.T, n)  # (c, w, 2), (c, w, b)
    return grid.reshape(-1, 2)[loglik.reshape(-1, repeats).argmax(axis=0)]


def centre_profile(z: Z, solved: Counts, n: int) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Centres on a grid, and how far the log-likelihood of the best sigmoid there lies below the best of all."""
    grid, loglik = likelihoods(z, solved, n)
    return grid[:, 0, 0], loglik.max() - loglik.max(axis=1)


def wider(z: Z, solved: Counts, other: Counts, n: int) -> tuple[float, float, float]:
    """The widths of two sigmoids over the same settings, and the one-sided p that the first is the wider.

    The likelihood ratio compares two widths with one for both, the centres free.
    """
    grid, _ = likelihoods(z, solved, n)
    profiles = [likelihoods(z, counts, n)[1].max(axis=0) for counts in (solved, other)]  # (w,) each
    widths = [float(grid[0, each.argmax(), 1]) for each in profiles]
    ratio = 2 * (sum(each.max() for each in profiles) - sum(profiles).max())
    p = float(stats.chi2.sf(ratio, 1) / 2)
    return *widths, p if widths[0] > widths[1] else 1 - p


def explained(z: Z, solved: Counts, n: int, centre: float, width: float) -> float:
    """R^2 of the sigmoid over the settings' solved shares."""
    shares = solved / n
    return float(1 - np.sum((shares - expit((centre - z) / width)) ** 2) / np.sum((shares - shares.mean()) ** 2))


class Comparison(NamedTuple):
    """One sigmoid for all against one centre for each window length (a common width)."""

    centres: Float[np.ndarray, " g"]
    p: float  # of the likelihood ratio, seeds independent


def compare(z: Z, group: Int[np.ndarray, " s"], solved: Counts, n: int) -> Comparison:
    """Likelihood-ratio test that the window length adds nothing to a logistic model that has z.

    Given d, N and sigma the seeds of a setting are independent, so their counts are binomial: whatever scatter is left
    is a lack of fit of z, which the test must not absorb.
    """
    grid, loglik = likelihoods(z, solved, n)
    groups = int(group.max()) + 1
    masked = [np.where(group == g, solved, 0) for g in range(groups)]
    sizes = [np.where(group == g, n, 0) for g in range(groups)]
    each = [likelihoods(z, counts, size)[1] for counts, size in zip(masked, sizes, strict=True)]  # (c, w) per group
    width = int(sum(part.max(axis=0) for part in each).argmax())
    ratio = 2 * (sum(part[:, width].max() for part in each) - loglik.max())
    centres = np.array([grid[part[:, width].argmax(), width, 0] for part in each])
    return Comparison(centres, float(stats.chi2.sf(max(ratio, 0.0), groups - 1)))


def _likeliest(loss, z: Z, groups: int):
    """The minimum of a negative log-likelihood over centres and log width."""
    bounds = [(z.min(), z.max())] * groups + [tuple(np.log(WIDTHS))]
    starts = [np.array([centre] * groups + [0.0]) for centre in np.quantile(z, (0.2, 0.4, 0.6))]
    tries = [minimize(loss, x, method="L-BFGS-B", bounds=bounds) for x in starts]
    return min(tries, key=lambda tried: tried.fun)


def _binomial(z: Z, group, solved: Counts, n: int, x: Float[np.ndarray, " k"]) -> float:
    logit = (x[group] - z) / np.exp(x[-1])
    return float(-np.sum(solved * log_expit(logit) + (n - solved) * log_expit(-logit)))
