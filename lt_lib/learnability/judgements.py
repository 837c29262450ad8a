"""Estimates and verdicts of the point-mass study: the fitted curve, coverage, fair coins, edges (Fig. 3)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats as scipy_stats

from lt_lib.learnability import sigmoid
from lt_lib.learnability.predictor import CONFIDENCE, CURVES, Curve, Curves
from lt_lib.learnability.z_study import CEILING, CHANCE, Runs
from lt_lib.report import stats
from lt_lib.store.files import write_atomically

ALPHA = 0.05


def curve_of(runs: Runs, updates: int, repeats: int, rng: np.random.Generator, made_of: str) -> Curve:
    """The sigmoid through the solved shares after `updates`, with `repeats` replicates over resampled settings."""
    z, solved = runs.per_setting(runs.z), runs.solved(updates)
    centre, width = sigmoid.fit(z, solved, runs.seeds)
    replicates = sigmoid.bootstrap(z, solved, runs.seeds, repeats, rng).round(4)
    return Curve(centre=centre, width=width, replicates=tuple(map(tuple, replicates.tolist())), made_of=made_of)


def centre_interval(curve: Curve) -> tuple[float, float]:
    """Bootstrap percentiles of the centre."""
    low, high = np.quantile(np.array(curve.replicates)[:, 0], [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def keep_curves(curves: Mapping[str, Curve], main: str, outputs: Path) -> None:
    """Writes the curves, and the name of the default one, where the predictor reads them."""
    write_atomically(outputs / CURVES, (Curves(main=main, curves=dict(curves)).model_dump_json() + "\n").encode())


def at_chance(success: Float[np.ndarray, " r"]) -> Bool[np.ndarray, " r"]:
    """Which runs end at chance."""
    return (success >= CHANCE[0]) & (success <= CHANCE[1])


def outcomes(success: Float[np.ndarray, " r"]) -> dict[str, int]:
    """Number of runs that end at ceiling, at chance and elsewhere."""
    ceiling, chance = success >= CEILING, at_chance(success)
    return {"ceiling": int(ceiling.sum()), "chance": int(chance.sum()), "between": int((~ceiling & ~chance).sum())}


def separation(solved: Bool[np.ndarray, " r"], coverage: Float[np.ndarray, " r"]) -> float:
    """AUC: the probability that a solved run covers more than an unsolved one, ties counting half."""
    with_, without = coverage[solved], coverage[~solved]
    if not len(with_) or not len(without):
        return 0.5
    return float(scipy_stats.mannwhitneyu(with_, without).statistic / (len(with_) * len(without)))


def fair_coin_best(runs: int, episodes: int) -> tuple[float, float]:
    """95% interval of the highest share of heads among `runs` fair coins, tossed `episodes` times each."""
    tails = np.array([(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2]) ** (1 / runs)
    low, high = scipy_stats.binom.ppf(tails, episodes, 0.5) / episodes
    return float(low), float(high)


def majority_edge(runs: Runs, updates: int) -> float:
    """The largest z at which most seeds of a setting are solved; 0 if none."""
    solved = runs.solved(updates) > runs.seeds / 2
    return float(runs.per_setting(runs.z)[solved].max(initial=0.0))


def compare(runs: Runs, updates: int) -> sigmoid.Comparison:
    """Whether the window length adds anything to z."""
    group = np.unique(runs.per_setting(runs.window), return_inverse=True)[1]
    return sigmoid.compare(runs.per_setting(runs.z), group, runs.solved(updates), runs.seeds)


def hit_edge(windows: float) -> float:
    """The z at which a fixed policy has even odds of arriving at least once in this many windows."""
    return float(scipy_stats.norm.isf(-np.expm1(np.log(0.5) / windows)))


def mean_by_setting(runs: Runs, values: Float[np.ndarray, " r"]) -> tuple[float, float, float]:
    """Mean over runs and its 95% Student-t interval; the setting is the unit."""
    means = values.reshape(-1, runs.seeds).mean(1)
    return float(means.mean()), *stats.mean_interval(means)


def judge_centre(curve: Curve, paper: float) -> dict[str, Any]:
    """The centre as a finding."""
    low, high = centre_interval(curve)
    finding = {"value": curve.centre, "low": low, "high": high, "holds": bool(low <= paper <= high)}
    return finding | {"test": "95% bootstrap interval over settings contains the paper's"}


def judge_collapse(comparison: sigmoid.Comparison, explained: float) -> dict[str, Any]:
    """Whether one curve is enough, as a finding."""
    holds = comparison.p >= ALPHA
    test = f"likelihood ratio of N given z, seeds clustered by setting; R² of the single curve {explained:.3f}"
    return {"value": "one curve" if holds else "N matters", "p": comparison.p, "holds": holds, "test": test}


def judge_control(success: Float[np.ndarray, " r"], episodes: int) -> dict[str, Any]:
    """The highest success among runs with an empty message, as a finding, against as many fair coins."""
    low, high = fair_coin_best(len(success), episodes)
    best = float(success.max())
    own = stats.wilson(round(best * episodes), episodes)
    test = f"95% interval of the highest of {len(success)} fair coins of {episodes:,} tosses: {low:.4f} to {high:.4f}"
    finding = {"value": best, "low": own[0], "high": own[1], "n": len(success)}
    return finding | {"holds": bool(low <= best <= high), "test": test}
