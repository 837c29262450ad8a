"""What a seed ends with: its last training episodes."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Num, Shaped

SOLVED = 0.9  # share from which a seed counts as solved, as in the paper's 2 of 3 raw seeds near 0.95
LAST = 500  # training episodes over which Table III takes a seed's share, choices sampled


def final_episodes(seeds: Sequence[Mapping[str, Any]], name: str) -> Shaped[np.ndarray, "seeds episodes"]:
    """Per seed, 'optimal' or 'success' in each of its last LAST training episodes, or in all where they are fewer."""
    fewest = min([LAST, *(len(seed[name]) for seed in seeds)])
    return np.stack([seed[name][-fewest:] for seed in seeds])


def final_shares(seeds: Sequence[Mapping[str, Any]], name: str) -> Num[np.ndarray, " seeds"]:
    """Per seed, the mean of `final_episodes`."""
    return final_episodes(seeds, name).mean(axis=1)
