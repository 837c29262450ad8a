"""Fits of the share of solved runs against z: one sigmoid, one per window length, and their comparison.

The setting is the unit: its seeds share d, N and sigma, so the bootstrap resamples whole settings and the model
comparison allows the counts of a setting more scatter than a binomial.

z (S,) of the settings, solved (S,) counts out of n seeds each, group (S,) index of the window length.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import stats
from scipy.optimize import minimize
from scipy.special import expit, log_expit

WIDTHS = (0.02, 20.0)  # of the sigmoid; without a lower bound no fit exists if one z separates the outcomes
ALIKE = (1e-6, 0.99)  # correlation between seeds of one setting
Z, Counts = Float[np.ndarray, " s"], Int[np.ndarray, " s"]


def fit(z: Z, solved: Counts, n: int) -> tuple[float, float]:
    """Maximum-likelihood centre and width of the sigmoid, seeds binomial."""
    centre, log_width = _likeliest(partial(_binomial, z, np.zeros(len(z), int), solved, n), z, 1).x
    return float(centre), float(np.exp(log_width))


def bootstrap(z: Z, solved: Counts, n: int, repeats: int, rng: np.random.Generator) -> Float[np.ndarray, "b 2"]:
    """Centre and width over resampled settings, each by maximum likelihood on a grid (centres 0.05 apart)."""
    centres, widths = np.arange(z.min(), z.max() + 0.05, 0.05), np.geomspace(*WIDTHS, 50)
    grid = np.stack(np.meshgrid(centres, widths, indexing="ij"), -1).reshape(-1, 2)
    logit = (grid[:, :1] - z) / grid[:, 1:]
    by_setting = solved * log_expit(logit) + (n - solved) * log_expit(-logit)  # (sigmoids, S)
    often = rng.multinomial(len(z), np.full(len(z), 1 / len(z)), repeats)  # how often each setting is drawn
    return grid[[np.argmax(by_setting @ times) for times in often]]


def explained(z: Z, solved: Counts, n: int, centre: float, width: float) -> float:
    """R^2 of the sigmoid over the settings' solved shares."""
    shares = solved / n
    return float(1 - np.sum((shares - expit((centre - z) / width)) ** 2) / np.sum((shares - shares.mean()) ** 2))


class Comparison(NamedTuple):
    """One sigmoid for all against one centre per window length (common width)."""

    centres: Float[np.ndarray, " g"]
    statistic: float  # twice the difference of log-likelihoods, seeds of a setting correlated (beta-binomial)
    p: float
    naive_p: float  # the same with all seeds independent (binomial)
    alike: float  # correlation between seeds of a setting under one curve


def compare(z: Z, group: Int[np.ndarray, " s"], solved: Counts, n: int) -> Comparison:
    """Likelihood-ratio test of whether the window length adds anything to a logistic model in z."""
    groups, together = int(group.max()) + 1, np.zeros(len(z), int)
    naive = [_likeliest(partial(_binomial, z, g, solved, n), z, int(g.max()) + 1) for g in (together, group)]
    clustered = [
        _likeliest(partial(_beta_binomial, z, g, solved, n), z, int(g.max()) + 1, start)
        for g, start in zip((together, group), naive, strict=True)
    ]
    ratios = [2 * (one.fun - each.fun) for one, each in (naive, clustered)]
    naive_p, p = (float(stats.chi2.sf(max(ratio, 0.0), groups - 1)) for ratio in ratios)
    return Comparison(clustered[1].x[:groups], float(ratios[1]), p, naive_p, float(clustered[0].x[-1]))


def _likeliest(loss, z: Z, groups: int, start=None):
    """Minimises a negative log-likelihood over centres, log width and, given a start without it, correlation."""
    bounds = [(z.min(), z.max())] * groups + [tuple(np.log(WIDTHS))]
    if start is None:
        starts = [np.array([centre] * groups + [0.0]) for centre in np.quantile(z, (0.2, 0.4, 0.6))]
    else:
        bounds += [ALIKE]
        starts = [np.append(start.x, alike) for alike in (0.001, 0.1, 0.4)]
    tries = [minimize(loss, x, method="L-BFGS-B", bounds=bounds) for x in starts]
    return min(tries, key=lambda tried: tried.fun)


def _binomial(z: Z, group, solved: Counts, n: int, x: Float[np.ndarray, " k"]) -> float:
    logit = (x[group] - z) / np.exp(x[-1])
    return float(-np.sum(solved * log_expit(logit) + (n - solved) * log_expit(-logit)))


def _beta_binomial(z: Z, group, solved: Counts, n: int, x: Float[np.ndarray, " k"]) -> float:
    share = np.clip(expit((x[group] - z) / np.exp(x[-2])), 1e-9, 1 - 1e-9)
    spread = (1 - x[-1]) / x[-1]
    return float(-stats.betabinom.logpmf(solved, n, share * spread, (1 - share) * spread).sum())
