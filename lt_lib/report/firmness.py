"""How firm a verdict is: the share of resamples of its seeds and episodes that give the same one."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

RESAMPLES, FEW = 200, 5  # where a verdict is given, and where none is and a judge must only bear it
FRAGILE = 0.8  # share of resamples below which a verdict is marked fragile


def firmness(
    judge: Callable[..., Any],
    samples: Sequence[np.ndarray],
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
    *,
    paired: bool = False,
    fixed: bool = False,
) -> float:
    """Share of resamples on which `judge(*samples)` gives what it gives on the samples themselves.

    A sample is (seeds,) values or (seeds, episodes) outcomes. Seeds are drawn with replacement, and within each seed so
    many episodes as it has.

    paired  the samples share their seeds and episodes, and are resampled alike
    fixed   the first axis is a fixed design, such as the rows of a table, and is not resampled
    """
    verdict, kept = judge(*samples), 0
    for _ in range(resamples):
        if paired:
            places = _places(samples[0], rng, fixed)
            kept += judge(*(sample[places] for sample in samples)) == verdict
        else:
            kept += judge(*(sample[_places(sample, rng, fixed)] for sample in samples)) == verdict
    return kept / resamples


def _places(sample: np.ndarray, rng: np.random.Generator, fixed: bool) -> tuple[np.ndarray, ...]:
    """Indices of one resample."""
    n = len(sample)
    rows = np.arange(n) if fixed else rng.integers(0, n, n)
    if sample.ndim == 1:
        return (rows,)
    return rows[:, None], rng.integers(0, sample.shape[1], sample.shape[:2])
