"""The judges that several studies share: samples in, the fields of a finding out (see `claims.Finding`).

A sample is an array (seeds, episodes) of 0 and 1. Every judge states its test, and every test can fail.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from lt_lib.report import stats
from lt_lib.report.shares import SOLVED
from lt_lib.report.stats import ALPHA, Outcomes

AT_CHANCE = 0.1  # a quarter of the way from chance to SOLVED: no seed so near has learned to choose


def estimate(outcomes: Outcomes) -> dict[str, Any]:
    """The mean over seeds, every seed, and the interval."""
    seeds = outcomes.mean(axis=1)
    low, high = stats.interval(outcomes)
    return {"value": seeds.mean(), "seeds": seeds, "low": low, "high": high}


def above(outcomes: Outcomes, reference: Outcomes, *, of: str) -> dict[str, Any]:
    """A row whose seeds must lie above those of a reference."""
    p = stats.rank_test(outcomes.mean(axis=1), reference.mean(axis=1))
    return estimate(outcomes) | {"test": f"exact rank test: above {of}", "p": p, "holds": p < ALPHA}


def below(outcomes: Outcomes, reference: Outcomes, *, of: str) -> dict[str, Any]:
    """A row whose seeds must lie below those of a reference."""
    p = stats.rank_test(reference.mean(axis=1), outcomes.mean(axis=1))
    return estimate(outcomes) | {"test": f"exact rank test: below {of}", "p": p, "holds": p < ALPHA}


def at_chance(outcomes: Outcomes) -> dict[str, Any]:
    """A row that must be at chance."""
    p = stats.equivalence(outcomes, 0.5, AT_CHANCE)
    return estimate(outcomes) | {"test": f"equivalence with 0.5 ± {AT_CHANCE} (TOST)", "p": p, "holds": p < ALPHA}


def alike(outcomes: Outcomes, *references: Outcomes, of: str, margin: float) -> dict[str, Any]:
    """Words that hold if the first row is within a margin of every reference."""
    p = max(stats.equivalence(outcomes, reference, margin) for reference in references)
    gaps = ", ".join(f"{outcomes.mean() - reference.mean():+.3f}" for reference in references)
    return words(p < ALPHA, f"equivalence with {of} ± {margin} (TOST): {gaps}", p=p, n=len(outcomes))


def words_below(outcomes: Outcomes, reference: Outcomes, *, of: str) -> dict[str, Any]:
    """Words that hold if seeds lie below those of a reference (exact rank test)."""
    found = below(outcomes, reference, of=of)
    gap = f"{outcomes.mean():.3f} against {reference.mean():.3f}"
    return words(found["holds"], f"{found['test']}: {gap}", p=found["p"], n=len(outcomes))


def words_above(outcomes: Outcomes, reference: Outcomes, *, of: str) -> dict[str, Any]:
    """Words that hold if seeds lie above those of a reference (exact rank test)."""
    found = above(outcomes, reference, of=of)
    gap = f"{outcomes.mean():.3f} against {reference.mean():.3f}"
    return words(found["holds"], f"{found['test']}: {gap}", p=found["p"], n=len(outcomes))


def more(outcomes: Outcomes, reference: Outcomes, *, of: str) -> dict[str, Any]:
    """Words that hold if more seeds are solved than of a reference (Fisher's exact test)."""
    counts = [(int((side.mean(axis=1) >= SOLVED).sum()), len(side)) for side in (outcomes, reference)]
    p = stats.fewer(*reversed(counts))
    shares = " and ".join(f"{k} of {n}" for k, n in counts)
    return words(p < ALPHA, f"Fisher's exact test of solved seeds, {of}: {shares}", p=p, n=len(outcomes))


def solves(outcomes: Outcomes, reference: Outcomes, *, of: str) -> dict[str, Any]:
    """How many seeds are solved; the seeds must lie above those of a reference."""
    return _solved(outcomes) | {key: above(outcomes, reference, of=of)[key] for key in ("test", "p", "holds")}


def solves_fewer(outcomes: Outcomes, reference: Outcomes, *, of: str) -> dict[str, Any]:
    """How many seeds are solved; the seeds must lie below those of a reference."""
    return _solved(outcomes) | {key: below(outcomes, reference, of=of)[key] for key in ("test", "p", "holds")}


def solves_none(outcomes: Outcomes) -> dict[str, Any]:
    """How many seeds are solved; it must be none, of enough seeds to exclude one in four."""
    found = _solved(outcomes)
    upper = stats.wilson(found["value"], len(outcomes))[1]
    test = f"none solved, and the 95% interval excludes one in four: at most {upper:.2f}"
    return found | {"test": test, "holds": found["value"] == 0 and upper < 0.25}


def _solved(outcomes: Outcomes) -> dict[str, Any]:
    shares = outcomes.mean(axis=1)
    return {"value": int((shares >= SOLVED).sum()), "seeds": shares, "n": len(shares)}


def at_least(outcomes: Outcomes, *, share: float) -> dict[str, Any]:
    """A row that every seed must keep above a share, by an exact binomial test of its episodes."""
    p = max(stats.above(int(seed.sum()), len(seed), share) for seed in outcomes)
    test = f"exact binomial test of every seed: above {share}; the largest p"
    return estimate(outcomes) | {"test": test, "p": p, "holds": p < ALPHA}


def falls(*rows: Outcomes, words: str = "monotone") -> dict[str, Any]:
    """Words that hold if the means fall from row to row; p is the largest of the steps' exact one-sided rank tests."""
    shares = [row.mean(axis=1) for row in rows]
    p = max(stats.rank_test(upper, lower) for upper, lower in pairwise(shares))
    down = all(upper.mean() > lower.mean() for upper, lower in pairwise(shares))
    return {
        "value": words if down else f"not {words}",
        "test": "exact rank test of every step, the largest p",
        "p": p,
        "holds": down and p < ALPHA,
    }


def within(*cells: Outcomes, low: float, high: float) -> dict[str, Any]:
    """Words that hold if every share of every cell lies in a range that the paper prints, within sampling error.

    A seed's share lies within if its Wilson interval, widened to all cells by Bonferroni's rule of ranges, meets it.
    """
    shares = np.concatenate([cell.mean(axis=1) for cell in cells])
    sizes = np.concatenate([[cell.shape[1]] * len(cell) for cell in cells])
    slack = stats.coin_slack(len(shares), int(sizes.min()))
    inside = bool((shares >= low - slack).all() and (shares <= high + slack).all())
    test = f"every cell within {low} to {high}, ± {slack:.2f} for {sizes.min()} episodes"
    return words(inside, f"{test}: {shares.min():.3f} to {shares.max():.3f}", n=len(shares))


def spread(seeds: np.ndarray, *, sd: float, n: int) -> dict[str, Any]:
    """The standard deviation over seeds beside a printed one; it must not be another by the F test."""
    own, p = float(np.std(seeds, ddof=1)), stats.spread_test(seeds, sd, n)
    return {
        "value": own,
        "n": len(seeds),
        "test": "F test of the two variances; holds from 0.05",
        "p": p,
        "holds": p >= ALPHA,
    }


def words(yes: bool | np.bool_, test: str, **fields: Any) -> dict[str, Any]:
    """A claim in words, by a comparison that the test states."""
    return {"value": "yes" if yes else "no", "holds": bool(yes), "test": test} | fields


def ends(shares: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """The smallest and the largest of some shares."""
    return float(min(shares)), float(max(shares))
