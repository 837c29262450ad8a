"""What a seed ends with: shares over its last training episodes."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

SOLVED = 0.9  # share from which a seed counts as solved, as in the paper's 2 of 3 raw seeds near 0.95


def final_shares(seeds: Sequence[Mapping[str, Any]], name: str, last: int = 500) -> np.ndarray:
    """Per seed, the mean of 'optimal' or 'success' over its last training episodes, choices sampled."""
    return np.array([seed[name][-last:].mean() for seed in seeds])


def solved(seeds: Sequence[Mapping[str, Any]], name: str) -> int:
    """How many seeds reach SOLVED by `final_shares`."""
    return int((final_shares(seeds, name) >= SOLVED).sum())
