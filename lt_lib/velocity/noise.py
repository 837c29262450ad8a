"""Exploration noise that remembers, a first-order autoregression (Section Effect of increased exploration noise)."""

import numpy as np
from jaxtyping import Bool, Float


def persistence(tau: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The lag-one autocorrelation exp(-1 / tau) of a correlation time in control steps; tau = 0 is iid."""
    tau = np.asarray(tau, float)
    if (tau < 0).any():
        raise ValueError(f"a correlation time must not be negative, got {tau.min()}")
    return np.exp(-1 / np.maximum(tau, 1e-9))


class Ar1:
    """n chains x_t = rho x_{t-1} + sqrt(1 - rho^2) e_t, e_t ~ N(0, 1): unit stationary variance at any tau.

    tau  (n,) correlation times in control steps; the autocorrelation at lag k is exp(-k / tau)
    """

    def __init__(self, tau: Float[np.ndarray, " n"], rng: np.random.Generator):
        self._rho, self._rng = persistence(tau), rng
        self._state = rng.standard_normal(len(self._rho))

    def step(self, fresh: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The next value of every chain; a fresh chain starts anew, from the stationary distribution."""
        innovation = self._rng.standard_normal(len(self._rho))
        moved = self._rho * self._state + np.sqrt(1 - self._rho**2) * innovation
        self._state = np.where(fresh, innovation, moved)
        return self._state.copy()
