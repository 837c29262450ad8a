"""Estimates and verdicts of the point-mass study: the fitted curve, coverage, fair coins, edges (Fig. 3)."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats as scipy_stats

from lt_lib.learnability import sigmoid
from lt_lib.learnability.predictor import CONFIDENCE, CURVES, Curve, Curves
from lt_lib.learnability.z_study import CEILING, CHANCE, Runs
from lt_lib.report import judges, stats
from lt_lib.report.stats import ALPHA
from lt_lib.store.files import content_digest, write_atomically

Success = Float[np.ndarray, "settings seeds"]
Z = Float[np.ndarray, " settings"]
NEAR = 1.0  # in z: how near a centre must lie to count as the paper's, about the step between neighbouring settings
SAME_SHARE = 0.1  # of the runs, as judges.AT_CHANCE
EXPLAINED = 0.9  # R^2 from which one curve describes all settings
FAR_OUT = 4  # settings at either end of z


def curve_of(runs: Runs, updates: int, repeats: int, rng: np.random.Generator, made_of: str) -> Curve:
    """The sigmoid through the solved shares after `updates`, with `repeats` replicates over resampled seeds."""
    z, solved = runs.per_setting(runs.z), runs.solved(updates)
    centre, width = sigmoid.fit(z, solved, runs.seeds)
    replicates = sigmoid.bootstrap(z, solved, runs.seeds, repeats, rng).round(4)
    return Curve(centre=centre, width=width, replicates=tuple(map(tuple, replicates.tolist())), made_of=made_of)


def mean_by_setting(runs: Runs, values: Float[np.ndarray, " r"]) -> tuple[float, float, float]:
    """Mean over runs and its 95% Student interval, with the settings as units."""
    means = values.reshape(-1, runs.seeds).mean(1)
    return float(means.mean()), *stats.mean_interval(means)


def centre_interval(curve: Curve) -> tuple[float, float]:
    """Bootstrap percentiles of the centre."""
    low, high = np.quantile(np.array(curve.replicates)[:, 0], [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def keep_curves(curves: Mapping[str, Curve], main: str, outputs: Path) -> None:
    """Writes the curves where the predictor looks for them, with the name of the one it answers from."""
    content = Curves(main=main, curves=dict(curves)).model_dump(mode="json")
    text = json.dumps({"sha256": content_digest(content), **content})
    write_atomically(outputs / CURVES, (text + "\n").encode())


def at_chance(success: Float[np.ndarray, " r"]) -> Bool[np.ndarray, " r"]:
    """Which runs end at chance."""
    return (success >= CHANCE[0]) & (success <= CHANCE[1])


def outcomes(success: Float[np.ndarray, " r"]) -> dict[str, int]:
    """How many runs end at ceiling, at chance, and anywhere else."""
    ceiling, chance = success >= CEILING, at_chance(success)
    return {"ceiling": int(ceiling.sum()), "chance": int(chance.sum()), "between": int((~ceiling & ~chance).sum())}


def separation(solved: Bool[np.ndarray, " r"], coverage: Float[np.ndarray, " r"]) -> float:
    """AUC: the probability that a solved run has the greater coverage of a pair, ties counting half."""
    with_, without = coverage[solved], coverage[~solved]
    if not len(with_) or not len(without):
        return 0.5
    return float(scipy_stats.mannwhitneyu(with_, without).statistic / (len(with_) * len(without)))


def fair_coin_best(runs: int, episodes: int) -> tuple[float, float]:
    """95% interval of the highest share of heads among `runs` fair coins, tossed `episodes` times each."""
    tails = np.array([(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2]) ** (1 / runs)
    low, high = scipy_stats.binom.ppf(tails, episodes, 0.5) / episodes
    return float(low), float(high)


def majority_edge(success: Success, z: Z) -> float:
    """The largest z at which most seeds of a setting are solved; 0 if there is none."""
    return float(z[(success >= CEILING).mean(axis=1) > 0.5].max(initial=0.0))


def compare(success: Success, z: Z, window: Int[np.ndarray, " s"]) -> sigmoid.Comparison:
    """Whether the window length adds anything to z."""
    group = np.unique(window, return_inverse=True)[1]
    return sigmoid.compare(z, group, (success >= CEILING).sum(axis=1), success.shape[1])


def hit_edge(windows: float) -> float:
    """The z at which one of so many windows of a policy that does not move arrives with even odds."""
    return float(scipy_stats.norm.isf(-np.expm1(np.log(0.5) / windows)))


def centre(success: Success, *, z: Z, paper: float) -> dict[str, Any]:
    """The centre; holds if the likelihood excludes centres NEAR or farther from the paper's, on either side."""
    n, solved = success.shape[1], (success >= CEILING).sum(axis=1)
    centres, below_best = sigmoid.centre_profile(z, solved, n)
    inside = centres[2 * below_best <= scipy_stats.chi2.isf(ALPHA, 1)]
    near = np.abs(centres - paper) < NEAR
    p = float(scipy_stats.chi2.sf(2 * below_best[~near].min(initial=np.inf), 1) / 2) if near.any() else 1.0
    fitted = sigmoid.fit(z, solved, n)[0]
    return {
        "value": fitted,
        "low": float(min(inside.min(), fitted)),
        "high": float(max(inside.max(), fitted)),
        "n": success.size,
        "test": f"likelihood ratio: centre within {NEAR:g} of the paper's",
        "p": p,
        "holds": bool(abs(fitted - paper) < NEAR and p < ALPHA),
    }


def collapse(success: Success, *, z: Z, window: Int[np.ndarray, " s"]) -> dict[str, Any]:
    """Whether settings of equal z fall on one curve whatever N: N adds nothing, and the one curve explains the rest."""
    n, solved = success.shape[1], (success >= CEILING).sum(axis=1)
    comparison, explained = compare(success, z, window), sigmoid.explained(z, solved, n, *sigmoid.fit(z, solved, n))
    holds = comparison.p >= ALPHA and explained >= EXPLAINED
    return {
        "value": "one curve" if holds else "not one curve",
        "n": success.size,
        "test": f"R² of one curve {explained:.3f}, from {EXPLAINED}; likelihood ratio of N given z, p from {ALPHA}",
        "p": comparison.p,
        "holds": holds,
        "note": f"centres by N: {', '.join(f'{each:.2f}' for each in comparison.centres)}",
    }


def ceiling(success: Success, *, paper: int) -> dict[str, Any]:
    """How many runs end at ceiling; holds if their share is the paper's within SAME_SHARE (95% interval)."""
    count = int((success >= CEILING).sum())
    low, high = stats.wilson(count, success.size)
    share = paper / success.size
    test = f"95% interval of the share, {low:.2f} to {high:.2f}, within {share:.3f} ± {SAME_SHARE}"
    holds = share - SAME_SHARE <= low and high <= share + SAME_SHARE
    ends = {"low": low * success.size, "high": high * success.size}
    return {"value": count, "n": success.size, "test": test, "holds": holds} | ends


def between(success: Success) -> dict[str, Any]:
    """How many runs end neither at ceiling nor at chance; holds if the 95% interval of their share excludes 0.05."""
    counts = outcomes(success.ravel())
    upper = stats.wilson(counts["between"], success.size)[1]
    test = f"95% interval of the share at most {upper:.3f}, below 0.05"
    return {"value": counts["between"], "n": success.size, "test": test, "holds": upper < 0.05}


def separated(
    success: Float[np.ndarray, " r"], coverage: Float[np.ndarray, " r"], early: Float[np.ndarray, " r"]
) -> dict[str, Any]:
    """Whether coverage separates solved from unsolved runs completely.

    A solved run keeps entering the alternative side, so the test asks it of the first quarter of training alone.
    """
    auc, first = (separation(success >= CEILING, part) for part in (coverage, early))
    return {
        "value": "complete" if auc == 1 else "incomplete",
        "n": len(success),
        "test": f"AUC of coverage {auc:.4f}; of the first quarter of training {first:.4f}, which must be 1 too",
        "holds": auc == 1 and first == 1,
    }


def every_setting(success: Success) -> dict[str, Any]:
    """The share of runs at ceiling; holds if the 95% interval stays above 0.95."""
    count = int((success >= CEILING).sum())
    low, high = stats.wilson(count, success.size)
    ends = {"low": low, "high": high, "n": success.size}
    return {
        "value": count / success.size,
        "test": f"95% interval above 0.95: from {low:.3f}",
        "holds": low > 0.95,
    } | ends


def control(success: Float[np.ndarray, " r"], *, episodes: int) -> dict[str, Any]:
    """The highest success of runs with an empty message, against as many fair coins."""
    low, high = fair_coin_best(len(success), episodes)
    best = float(success.max())
    own = stats.wilson(round(best * episodes), episodes)
    test = f"within the 95% interval of the highest of {len(success)} fair coins: {low:.4f} to {high:.4f}"
    ends = {"low": own[0], "high": own[1], "n": len(success)}
    return {"value": best, "test": test, "holds": bool(low <= best <= high)} | ends


def edges(slow: Success, fast: Success, *, z: Z) -> dict[str, Any]:
    """The majority-solved edges of the smallest and the largest rate; holds if more runs are solved at the larger."""
    counts = [(int((side >= CEILING).sum()), side.size) for side in (slow, fast)]
    p = stats.fewer(*counts)
    words = " and ".join(f"{k} of {n}" for k, n in counts)
    found = {"value": (majority_edge(slow, z), majority_edge(fast, z)), "n": slow.size, "p": p}
    return found | {"test": f"Fisher's exact test, fewer runs solved at the smaller rate: {words}", "holds": p < ALPHA}


def fast_edge(slow: Success, fast: Success, *, z: Z) -> dict[str, Any]:
    """As `edges`, for the edge of the largest rate alone."""
    found = edges(slow, fast, z=z)
    return found | {"value": found["value"][1]}


def falls_to_zero(success: Success, *, z: Z) -> dict[str, Any]:
    """Whether the solved share falls from 1 to 0: all runs of the settings of smallest z, none of largest."""
    solved, order = success >= CEILING, np.argsort(z)
    first, last = solved[order[:FAR_OUT]], solved[order[-FAR_OUT:]]
    test = f"smallest z: {first.sum()} of {first.size} solved; largest: {last.sum()} of {last.size}"
    return judges.words(bool(first.all() and not last.any()), test, n=success.size)


def softened(drifting: Success, still: Success, *, z: Z) -> dict[str, Any]:
    """Whether Adam's walk makes the edge soft: the sigmoid without it is narrower."""
    counts = [(side >= CEILING).sum(axis=1) for side in (drifting, still)]
    first, second, p = sigmoid.wider(z, *counts, drifting.shape[1])
    test = f"likelihood ratio of the widths: {first:.2f} with the walk, {second:.2f} without"
    return judges.words(p < ALPHA, test, p=p, n=drifting.size)


def inverse_score(scores: Float[np.ndarray, "sigmas windows"], *, sigmas: Float[np.ndarray, " k"]) -> dict[str, Any]:
    """Whether the score's magnitude falls as 1/sigma: the slope of its logarithm is -1 within 0.05."""
    slope = float(np.polyfit(np.log(sigmas), np.log(np.abs(scores).mean(axis=1)), 1)[0])
    return judges.words(
        abs(slope + 1) < 0.05, f"slope of log |score| on log sigma {slope:.3f}, -1 ± 0.05", n=scores.size
    )
