"""Temporally correlated exploration noise, an AR(1) process (Section Effect of increased exploration noise)."""

import numpy as np
from jaxtyping import Bool, Float


class Ar1:
    """n chains x_t = rho x_{t-1} + sqrt(1 - rho^2) e_t with e_t ~ N(0, 1): unit stationary variance for any tau.

    tau  (n,) correlation times in control steps: the autocorrelation at lag k is exp(-k / tau), and 0 is iid noise

    Raises ValueError for a negative tau.
    """

    def __init__(self, tau: Float[np.ndarray, " n"], rng: np.random.Generator):
        tau = np.asarray(tau, float)
        if (tau < 0).any():
            raise ValueError(f"a correlation time must not be negative, got {tau.min()}")
        self._rho, self._rng = np.exp(-1 / np.maximum(tau, 1e-9)), rng  # (n,)
        self._state = rng.standard_normal(len(self._rho))  # (n,)

    def step(self, fresh: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The next value of each chain; a fresh chain restarts from the stationary distribution."""
        innovation = self._rng.standard_normal(len(self._rho))  # (n,)
        moved = self._rho * self._state + np.sqrt(1 - self._rho**2) * innovation
        self._state = np.where(fresh, innovation, moved)
        return self._state.copy()
