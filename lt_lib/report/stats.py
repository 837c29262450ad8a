"""The statistics behind every verdict. One rule for all of them:

unit          the seed; episodes only say how well a seed's share is known, and are never pooled into a test of seeds
alpha         0.05, one-sided where the claim has a direction
every, none   a row that claims something of every part takes the largest p, a row that scans many cells Bonferroni's
margins       AS_GOOD where one row is said to match another, AT_REFERENCE where it is said to be no better than silence
pairing       episodes that share their draws are compared in pairs (McNemar), all others unpaired
intervals     Student's over seeds, but never narrower than Wilson's over the episodes, so equal seeds are no certainty

Outcomes are arrays (seeds, episodes) of 0 and 1. Standard deviations are those of a sample (ddof = 1).
"""

import warnings
from collections import Counter
from math import comb, log10
from operator import index
from typing import SupportsIndex

import numpy as np
from jaxtyping import Bool, Num, Shaped
from numpy.typing import ArrayLike
from scipy import stats
from statsmodels.stats.contingency_tables import mcnemar
from statsmodels.stats.proportion import proportion_confint

ALPHA = 0.05
AS_GOOD = 0.02  # three times the largest standard deviation that Table III prints for a solved row
AT_REFERENCE = 0.05  # the margin of proportions in claims.yaml: what would be another number in Table III

# sizes differ between the samples of one test, hence the underscores
Outcomes = Num[np.ndarray, "_seeds _episodes"] | Bool[np.ndarray, "_seeds _episodes"]


def wilson(successes: SupportsIndex, n: SupportsIndex) -> tuple[float, float]:
    """Wilson's 95% interval of a proportion, counted as successes out of n (Section Hardware), as plain numbers."""
    if not 0 <= index(successes) <= index(n) or index(n) == 0:
        raise ValueError(f"wilson: expected 0 <= successes <= n and n > 0, got {successes} of {n}")
    low, high = proportion_confint(index(successes), index(n), alpha=ALPHA, method="wilson")
    return max(0.0, float(low)), min(1.0, float(high))


def mean_interval(seeds: ArrayLike) -> tuple[float, float]:
    """Student's 95% interval of the mean of a proportion over seeds, clipped to [0, 1].

    It replaces the percentile bootstrap, which covers 84% instead of 95% at five seeds. One seed says nothing about the
    spread, so its interval is all of [0, 1].

    seeds  (n,) proportions in [0, 1]; anything else raises ValueError
    """
    values = np.asarray(seeds, dtype=float)
    if values.size == 0 or not ((values >= -1e-9) & (values <= 1 + 1e-9)).all():
        raise ValueError(f"mean_interval: expected proportions in [0, 1], got {values}")
    if values.size == 1:
        return 0.0, 1.0
    half = stats.t.ppf(1 - ALPHA / 2, values.size - 1) * values.std(ddof=1) / np.sqrt(values.size)
    return max(0.0, float(values.mean() - half)), min(1.0, float(values.mean() + half))


def interval(outcomes: Outcomes) -> tuple[float, float]:
    """95% interval of the mean over seeds: Student's over seeds, or Wilson's over all episodes where that is wider."""
    n = outcomes.size
    of_episodes = wilson(round(float(outcomes.sum())), n)
    if len(outcomes) == 1:
        return of_episodes
    of_seeds = mean_interval(outcomes.mean(axis=1))
    return max((of_seeds, of_episodes), key=lambda ends: ends[1] - ends[0])


def standard_error(outcomes: Outcomes) -> float:
    """Of the mean over seeds: from the spread of the seeds, and no smaller than the episodes alone would give.

    Two episodes of either kind are added for the latter (Agresti and Coull), so the error is never 0. Differences of
    paired outcomes, which lie in [-1, 1], are taken too.
    """
    lowest = -1.0 if (outcomes < 0).any() else 0.0
    padded = np.append(outcomes.astype(float), [lowest, lowest, 1.0, 1.0])
    of_episodes = padded.std() / np.sqrt(outcomes.size)
    of_seeds = outcomes.mean(axis=1).std(ddof=1) / np.sqrt(len(outcomes)) if len(outcomes) > 1 else 0.0
    return float(max(of_seeds, of_episodes))


def rank_test(greater: ArrayLike, less: ArrayLike) -> float:
    """Exact one-sided p that the first sample tends to larger values (Mann-Whitney), with ties.

    The p value is the share of all splits of the pooled values into samples of these sizes whose sum of midranks is at
    least the observed one; splits are counted by their sum. Scipy's method='exact' ignores ties, 'auto' falls back to a
    normal approximation when there are any (seeds at 1.0 often tie), and the permutation method rejects samples of one.
    Without overlap, p is 1 / C(n1 + n2, n1): 1/252 for five seeds against five, the smallest p that n = 5 can give
    (Section Gridworld).

    Raises ValueError for an empty sample and for values that are not finite.
    """
    pooled = np.concatenate([greater, less]).astype(float)
    if not np.isfinite(pooled).all():
        raise ValueError(f"rank_test: expected finite values, got {pooled}")
    size = np.size(greater)
    if not 0 < size < pooled.size:
        raise ValueError(f"rank_test: expected two samples, got {size} and {np.size(less)} values")
    ranks = [round(2 * rank) for rank in stats.rankdata(pooled)]  # midranks are multiples of 1/2
    splits: list[Counter[int]] = [Counter() for _ in range(size + 1)]  # how many ways to draw k ranks, by their sum
    splits[0][0] = 1
    for rank in ranks:
        for k in range(size, 0, -1):
            for total, ways in splits[k - 1].items():
                splits[k][total + rank] += ways
    observed = sum(ranks[:size])
    return sum(ways for total, ways in splits[size].items() if total >= observed) / comb(len(ranks), size)


def equivalence(outcomes: Outcomes, reference: Outcomes | float, margin: float) -> float:
    """p of two one-sided t tests (TOST) that a mean over seeds lies within `margin` of a reference's, or of a number.

    A small p means 'the same within the margin', which a large p of an ordinary test does not. Errors are those of
    `standard_error`; degrees of freedom are Welch's. One seed shows nothing, so its p is 1.
    """
    sides = [outcomes] if np.isscalar(reference) else [outcomes, reference]
    if min(map(len, sides)) < 2:
        return 1.0
    variances = np.array([standard_error(side) ** 2 for side in sides])
    freedom = np.array([len(side) - 1 for side in sides])
    total = variances.sum()
    gap = abs(float(outcomes.mean()) - float(np.mean(reference)))
    return float(stats.t.sf((margin - gap) / np.sqrt(total), total**2 / (variances**2 / freedom).sum()))


def mean_above(outcomes: Outcomes, share: float) -> float:
    """One-sided p that a mean over seeds is greater than `share`.

    The larger of Student's t over the seeds' shares and of the exact binomial over all episodes, so that neither
    scattered seeds nor seeds that agree by chance pass; a single seed has its episodes alone.
    """
    of_episodes = above(int(outcomes.sum()), outcomes.size, share)
    return max(of_episodes, _students(outcomes.mean(axis=1) - share)) if len(outcomes) > 1 else of_episodes


def mean_below(outcomes: Outcomes, share: float) -> float:
    """One-sided p that a mean over seeds is smaller than `share`, as `mean_above`."""
    return mean_above(1 - outcomes.astype(int), 1 - share)


def mean_less(one: Outcomes, other: Outcomes) -> float:
    """One-sided p that the first mean over seeds is the smaller.

    The larger of Welch's t over the seeds' shares and of Fisher's exact test over all episodes; single seeds have their
    episodes alone.
    """
    of_episodes = fewer(*((int(side.sum()), side.size) for side in (one, other)))
    if min(len(one), len(other)) == 1:
        return of_episodes
    return max(of_episodes, longer_mean(other.mean(axis=1), one.mean(axis=1)))


def _students(values: np.ndarray) -> float:
    """One-sided p that a mean is above 0; 0 or 1 for values without spread."""
    if np.ptp(values) < 1e-12:
        return float(values.mean() <= 0)
    return float(stats.ttest_1samp(values, 0.0, alternative="greater").pvalue)


def drop_test(intact_successes: SupportsIndex, corrupted_successes: SupportsIndex, n: SupportsIndex) -> float:
    """One-sided Fisher exact p that corruption lowers a head's success, n episodes per cell (Table IV)."""
    return fewer((corrupted_successes, n), (intact_successes, n))


def fewer(one: tuple[SupportsIndex, SupportsIndex], other: tuple[SupportsIndex, SupportsIndex]) -> float:
    """One-sided Fisher exact p that the first of two counts (successes, n) has the smaller proportion."""
    table = [[index(s), index(n) - index(s)] for s, n in (one, other)]
    return float(stats.fisher_exact(table, alternative="less").pvalue)


def above(successes: SupportsIndex, n: SupportsIndex, share: float) -> float:
    """Exact binomial p that a proportion is greater than `share`."""
    return float(stats.binomtest(index(successes), index(n), share, alternative="greater").pvalue)


def below(successes: SupportsIndex, n: SupportsIndex, share: float) -> float:
    """Exact binomial p that a proportion is smaller than `share`."""
    return float(stats.binomtest(index(successes), index(n), share, alternative="less").pvalue)


def sign_test(gained: int, lost: int) -> float:
    """Two-sided exact p that as many pairs gain as lose (McNemar's test, from the pairs that disagree)."""
    return float(mcnemar([[0, gained], [lost, 0]], exact=True).pvalue)


def paired_change(one: Shaped[np.ndarray, " n"], other: Shaped[np.ndarray, " n"]) -> float:
    """Two-sided exact McNemar p that paired outcomes of 0 and 1 differ."""
    one, other = one.astype(bool), other.astype(bool)
    return sign_test(int((~one & other).sum()), int((one & ~other).sum()))


def spread_test(seeds: ArrayLike, sd: float, n: int) -> float:
    """Two-sided F p that seeds have another variance than n seeds whose standard deviation is printed as `sd`."""
    own = np.std(seeds, ddof=1)
    if own == 0 or sd == 0:
        return float(own == sd)
    ratio = stats.f((np.size(seeds) - 1), n - 1)
    return float(min(1.0, 2 * min(ratio.cdf((own / sd) ** 2), ratio.sf((own / sd) ** 2))))


def coin_slack(cells: int, episodes: int) -> float:
    """Half-width within which all of so many fair coins, tossed `episodes` times each, stay with 95% (Bonferroni)."""
    return float(stats.norm.isf(ALPHA / 2 / cells) * 0.5 / np.sqrt(episodes))


def orders(value: float, other: float) -> float:
    """How many orders of magnitude lie between two positive numbers."""
    return abs(log10(value / other))


def longer_mean(values: ArrayLike, other: ArrayLike) -> float:
    """One-sided Welch p that the first of two samples has the greater mean; without any spread, 0 or 1."""
    if np.ptp(values) == 0 and np.ptp(other) == 0:
        return float(np.mean(values) <= np.mean(other))
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", "Precision loss", RuntimeWarning
        )  # of a sample without spread, which is exact
        return float(stats.ttest_ind(values, other, equal_var=False, alternative="greater").pvalue)


def paired_drop(one: Shaped[np.ndarray, " n"], other: Shaped[np.ndarray, " n"]) -> float:
    """One-sided exact McNemar p that paired outcomes of 0 and 1 fall from the first to the second."""
    one, other = one.astype(bool), other.astype(bool)
    lost, gained = int((one & ~other).sum()), int((~one & other).sum())
    return float(stats.binomtest(gained, lost + gained, 0.5, alternative="less").pvalue) if lost + gained else 1.0
