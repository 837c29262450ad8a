"""Estimates and judgements on frozen and boosted navigators (Section From Grid Actions to Velocity Commands).

A result is one of `coverage.roll_navigator` or, where the name says so, of `navigator.train_navigator`.
"""

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import rankdata, spearmanr

from lt_lib.envs.layout import SIDES
from lt_lib.report import judges, stats
from lt_lib.report.stats import ALPHA, Outcomes
from lt_lib.settings.velocity import Boost, RolloutConfig
from lt_lib.store.run import Result
from lt_lib.velocity.coverage import EVERY

RARE = 0.05  # coverage up to which exploration counts as not reaching the decision, the margin of Table II's coverage
COMPETENT = 0.5  # success above which a navigator counts as competent, and below which as collapsed
PROBED = 0.95  # accuracy of a probe that recovers the hazard
EXACT = 0.01  # share of full speed by which a command may be missed
COMMITTED = 0.95  # smallest share of one corridor, under either placement, that counts as commitment to it
EXACT_UP_TO = 8  # pairs up to which the rank test enumerates every order


# --- which corridor
def optimal(result: Result) -> Bool[np.ndarray, " episodes"]:
    """Whether the first corridor entered was the slab-free one, in row 0; entering neither counts as not."""
    first, slab = result["first"][0], result["slab"][0]  # (episodes,) each
    return (first >= 0) & (first != slab)


def commitment(result: Result, row: int = 0) -> tuple[int, float]:
    """The incumbent corridor and how firmly it is held.

    The incumbent is the corridor entered first in most episodes (0 left, 1 right). The second number is the share of
    episodes that enter it first, under the placement of the slab where that share is smaller.
    """
    first, slab = result["first"][row], result["slab"][row]  # (episodes,) each
    incumbent = int((first == 1).sum() > (first == 0).sum())
    return incumbent, float(min((first[slab == s] == incumbent).mean() for s in np.unique(slab)))


def has_committed(result: Result) -> bool:
    """Whether the navigator enters one corridor first in at least 95% of episodes under either placement."""
    return commitment(result)[1] >= COMMITTED


def least_share(first: Int[np.ndarray, " episodes"], slab: Int[np.ndarray, " episodes"]) -> float:
    """The share of the corridor entered first in most episodes, under the placement where it is smaller."""
    return commitment({"first": first[None], "slab": slab[None]})[1]


def all_committed(first: Int[np.ndarray, "n episodes"], slab: Int[np.ndarray, "n episodes"]) -> dict[str, Any]:
    """Route optimality of every training; holds if each has committed to one corridor under either placement.

    For a committed navigator route optimality is the share of draws with the slab in the other corridor, a coin.
    """
    least = [least_share(*pair) for pair in zip(first, slab, strict=True)]
    chosen = (first >= 0) & (first != slab)
    ends = np.array([stats.wilson(int(row.sum()), len(row)) for row in chosen])
    return {
        "value": chosen.mean(axis=1),
        "seeds": chosen.mean(axis=1),
        "low": ends[:, 0],
        "high": ends[:, 1],
        "test": f"one corridor first in {COMMITTED:.0%} of episodes under either placement; least {min(least):.3f}",
        "holds": min(least) >= COMMITTED,
    }


def range_committed(first: Int[np.ndarray, "n episodes"], slab: Int[np.ndarray, "n episodes"]) -> dict[str, Any]:
    """As `all_committed`, for a claim that prints the smallest and the largest route optimality."""
    found = all_committed(first, slab)
    places = [int(np.argmin(found["value"])), int(np.argmax(found["value"]))]
    return found | {key: found[key][places] for key in ("value", "low", "high")}


def one_committed(first: Int[np.ndarray, "1 episodes"], slab: Int[np.ndarray, "1 episodes"]) -> dict[str, Any]:
    """As `all_committed`, for a single training, whose episodes are its sample."""
    found = all_committed(first, slab)
    return found | {key: found[key][0] for key in ("value", "low", "high")} | {"seeds": None, "n": first.size}


def held_near(across: Float[np.ndarray, " episodes"], *, d: float) -> dict[str, Any]:
    """Whether the mean sideways command held is near d: within a fifth of it, so that the other side is near 2 d."""
    p = stats.equivalence(across[:, None], d, 0.2 * d)
    test = f"equivalence of the held command {across.mean():.2f} with d = {d:.2f} ± a fifth (TOST over episodes)"
    return judges.words(p < ALPHA, test, p=p, n=len(across))


def held_command(result: Result, step: float, window: int) -> Float[np.ndarray, " episodes"]:
    """Mean sideways command of every recorded approach, without noise (row 1), as a share of full command.

    It is read off the recorded paths: metres moved sideways in the first `window` control steps, divided by what full
    command would cover.

    step    metres that one control step of full command covers
    window  control steps
    """
    across = result["path"][1][..., 1]  # (episodes, points): y in metres
    points = min(window // EVERY, across.shape[1] - 1)
    held = np.abs(across[:, points] - across[:, 0]) / (step * points * EVERY)
    return held[np.isfinite(held)]


def probe_recovers(right: Bool[np.ndarray, "1 draws"]) -> dict[str, Any]:
    """Whether a probe recovers the hazard from the latent: accuracy on held-out draws above PROBED."""
    k, n = int(right.sum()), right.size
    p = stats.above(k, n, PROBED)
    return judges.words(p < ALPHA, f"exact binomial: {k} of {n} held-out draws above {PROBED}", p=p, n=n)


# --- coverage
class Row(NamedTuple):
    """Counts over the episodes of one row of the sweep."""

    n: int
    covered: int  # entered the alternative corridor
    succeeded: int
    through: int  # succeeded without ever entering the alternative corridor

    @property
    def shares(self) -> tuple[float, float]:
        """Coverage and success."""
        return self.covered / self.n, self.succeeded / self.n

    @property
    def competence(self) -> float:
        """Success among the episodes that did not enter the alternative corridor; NaN if all entered it."""
        return self.through / (self.n - self.covered) if self.covered < self.n else float("nan")


def count_rows(swept: Result, alternative: int) -> list[Row]:
    """The counts for each row of a sweep; `alternative` is the corridor (0 left, 1 right) whose entry is coverage."""
    covered, success = swept["entered"][..., alternative], swept["success"]  # (rows, episodes) each
    return [Row(len(c), int(c.sum()), int(s.sum()), int((s & ~c).sum())) for c, s in zip(covered, success, strict=True)]


def sweep_row(
    covered: Bool[np.ndarray, "1 episodes"],
    succeeded: Bool[np.ndarray, "1 episodes"],
    *,
    side: str,
    coverage: float,
    competent: bool | None,
) -> dict[str, Any]:
    """A row of the sweep: coverage and success, tested for what the paper says of both (`coverage.STATED`).

    side, coverage  whether coverage must be 'above' or 'below' this share
    competent       whether success must be above COMPETENT, or below; None if the paper prints one half
    """
    n, k, s = covered.size, int(covered.sum()), int(succeeded.sum())
    sides = {"above": stats.above, "below": stats.below}
    tests = {f"coverage {side} {coverage}": sides[side](k, n, coverage)}
    if competent is not None:
        where = "above" if competent else "below"
        tests[f"success {where} {COMPETENT}"] = sides[where](s, n, COMPETENT)
    low, high = zip(stats.wilson(k, n), stats.wilson(s, n), strict=True)
    p = max(tests.values())
    return {
        "value": (k / n, s / n),
        "low": low,
        "high": high,
        "n": n,
        "test": f"exact binomial: {' and '.join(tests)}; the larger p",
        "p": p,
        "holds": p < ALPHA,
    }


def opposed(covered: Bool[np.ndarray, "rows episodes"], succeeded: Bool[np.ndarray, "rows episodes"]) -> dict[str, Any]:
    """Whether coverage and success move in opposite directions over the rows.

    Behind a solid slab an entry costs a success by construction, so the test takes success among the episodes that did
    not enter the alternative corridor.
    """
    coverage, success = covered.mean(axis=1), succeeded.mean(axis=1)
    through = (succeeded & ~covered).sum(axis=1) / np.maximum(1, (~covered).sum(axis=1))
    rho, p = opposition(coverage, through)
    whole = opposition(coverage, success)[0]
    return {
        "value": "opposite" if whole < 0 else "not opposite",
        "n": len(covered),
        "test": f"Spearman's rank correlation of coverage with success off the alternative, {rho:.2f}, exact",
        "p": p,
        "holds": p < ALPHA,
        "note": f"success off the alternative falls from {through[0]:.2f} to {through.min():.2f}; "
        f"over all episodes the correlation is {whole:.2f}",
    }


def only_where_collapsed(
    covered: Bool[np.ndarray, "rows episodes"], succeeded: Bool[np.ndarray, "rows episodes"]
) -> dict[str, Any]:
    """Whether coverage becomes nonzero only at noise at which success has collapsed.

    It holds if some row is covered, and if in every row with an entry success is below COMPETENT (the largest p).
    """
    nonzero = covered.any(axis=1)
    p = max((stats.below(int(s.sum()), len(s), COMPETENT) for s in succeeded[nonzero]), default=1.0)
    most = succeeded[nonzero].mean(axis=1).max(initial=0.0)
    test = f"exact binomial of every row with an entry: success below {COMPETENT}; the largest is {most:.2f}"
    return judges.words(bool(nonzero.any()) and p < ALPHA, test, p=p, n=len(covered))


def noise_reaches(covered: Bool[np.ndarray, "1 episodes"]) -> dict[str, Any]:
    """Whether correlated noise in the window reaches the decision: coverage above RARE."""
    k, n = int(covered.sum()), covered.size
    p = stats.above(k, n, RARE)
    return judges.words(p < ALPHA, f"exact binomial: coverage {k} of {n} above {RARE}", p=p, n=n)


def competence_destroyed(
    quiet: Bool[np.ndarray, "1 episodes"], noisy: Bool[np.ndarray, "1 episodes"]
) -> dict[str, Any]:
    """Whether noise over the whole episode destroys competence: success below COMPETENT, and below the quiet row's."""
    (k, n), (q, m) = ((int(row.sum()), row.size) for row in (noisy, quiet))
    p = max(stats.below(k, n, COMPETENT), stats.fewer((k, n), (q, m)))
    return judges.words(
        p < ALPHA, f"success {k} of {n}: below {COMPETENT} and below {q} of {m}; the larger p", p=p, n=n
    )


def opposition(coverage: Float[np.ndarray, " n"], success: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Spearman's rank correlation of coverage and success, and the one-sided p that it is below 0.

    Up to EXACT_UP_TO pairs, p is exact, ties included: every order is enumerated. Beyond that it is scipy's t
    approximation. If either column is constant, the result is (0, 1).
    """
    if np.ptp(coverage) == 0 or np.ptp(success) == 0:
        return 0.0, 1.0
    if len(coverage) > EXACT_UP_TO:
        return tuple(map(float, spearmanr(coverage, success, alternative="less")))
    a, b = (rankdata(values) - (len(coverage) + 1) / 2 for values in (coverage, success))  # (n,) centred midranks
    products = np.array(list(permutations(b))) @ a  # (n!,)
    return float(a @ b / np.sqrt((a @ a) * (b @ b))), float(np.mean(products <= a @ b + 1e-9))


# --- what the oracle's bit does
class Diagnosis(NamedTuple):
    """What the bit does to each of the navigators trained with it, without noise."""

    shift: Float[np.ndarray, "seeds 2"]  # of the lateral mean when the bit flips, policy sds: approach, whole episode
    stayed: Bool[np.ndarray, "seeds rollouts"]  # enters the incumbent first, over both placements and both bits
    success: tuple[Bool[np.ndarray, "seeds episodes"], ...]  # incumbent free: true bit, flipped bit, same starts


def shifted(shift: Float[np.ndarray, " seeds"]) -> dict[str, Any]:
    """The bit's shift of the lateral mean (policy sds); holds if it exceeds 1 in every seed."""
    test = f"above 1 in every seed; the least is {shift.min():.2f}"
    spread = 1.96 * shift.std(ddof=1) / np.sqrt(len(shift)) if len(shift) > 1 else 0.0
    return {"value": shift.mean(), "seeds": shift, "test": test, "holds": bool(shift.min() > 1), "n": len(shift)} | (
        {"low": shift.mean() - spread, "high": shift.mean() + spread} if spread else {}
    )


def flip_costs(true: Bool[np.ndarray, "seeds episodes"], flipped: Bool[np.ndarray, "seeds episodes"]) -> dict[str, Any]:
    """Success with the true and with the flipped bit; holds if flipping costs every seed (one-sided McNemar)."""
    p = max(stats.paired_drop(*pair) for pair in zip(true, flipped, strict=True))
    ends = [stats.interval(side) for side in (true, flipped)]
    return {
        "value": (true.mean(), flipped.mean()),
        "low": [low for low, _ in ends],
        "high": [high for _, high in ends],
        "n": true.size,
        "test": "one-sided McNemar test of every seed, flipped below true; the largest p",
        "p": p,
        "holds": p < ALPHA,
    }


def bit_diagnosis(flips: Mapping[tuple[str, bool], Sequence[Result]], incumbents: Sequence[int]) -> Diagnosis:
    """Diagnoses the bit from `transfer.Examined.flips` and the incumbent corridor of each seed."""
    shift = [np.concatenate([r[i]["shift"][0] for r in flips.values()]).mean(0) for i in range(len(incumbents))]
    first = [np.concatenate([r[i]["first"][0] for r in flips.values()]) == side for i, side in enumerate(incumbents)]
    success = (
        np.stack([flips[SIDES[1 - side], truthful][i]["success"][0] for i, side in enumerate(incumbents)])
        for truthful in (True, False)
    )
    return Diagnosis(np.array(shift), np.array(first), tuple(success))


# --- the boost
def window_ratio(rollout: RolloutConfig, boost: Boost, factor: float = 1.0) -> float:
    """Aggregate score-function gradient of the steps outside the boosted window, over that of the steps inside.

    (N_out / N_in) (sigma_in / sigma_out) of Section Effect of increased exploration noise; 0 if the window spans the
    whole episode. The episode has `rollout.horizon` control steps, of which the first `boost.window` are inside.

    factor  sigma_in / sigma_out, the boosted noise over the policy's own

    Raises ValueError for an empty window or a factor that is not positive.
    """
    inside = min(boost.window, rollout.horizon)
    if inside == 0 or factor <= 0:
        raise ValueError(f"window_ratio: expected positive window and factor, got {boost.window} steps and {factor}")
    return (rollout.horizon - inside) / inside * factor


def boost_opens(*blocks: Bool[np.ndarray, "1 episodes"]) -> dict[str, Any]:
    """Alternative-corridor success with the boost, smallest and largest block; holds if all together exceed RARE."""
    k, n = sum(int(block.sum()) for block in blocks), sum(block.size for block in blocks)
    p = stats.above(k, n, RARE)
    return _range(blocks) | {"n": n, "test": f"exact binomial: {k} of {n} above {RARE}", "p": p, "holds": p < ALPHA}


def boost_fades(*blocks: Bool[np.ndarray, "1 episodes"], early: int) -> dict[str, Any]:
    """The same of the late blocks, after so many early ones; holds if success is below the early blocks'."""
    first, last = (
        (sum(int(block.sum()) for block in part), sum(block.size for block in part))
        for part in (blocks[:early], blocks[early:])
    )
    p = stats.fewer(last, first)
    return _range(blocks[early:]) | {
        "n": last[1],
        "test": "Fisher's exact test, below early",
        "p": p,
        "holds": p < ALPHA,
    }


def _range(blocks: Sequence[Outcomes]) -> dict[str, Any]:
    """The smallest and the largest share of some blocks, with their Wilson intervals."""
    shares = [block.mean() for block in blocks]
    ends = [blocks[int(place)] for place in (np.argmin(shares), np.argmax(shares))]
    intervals = [stats.wilson(int(block.sum()), block.size) for block in ends]
    low, high = zip(*intervals, strict=True)
    return {"value": (min(shares), max(shares)), "low": low, "high": high}


def alternative_outcomes(
    trained: Result, incumbent: int, edges: Sequence[int] | np.ndarray
) -> list[Bool[np.ndarray, "1 episodes"]]:
    """Whether each episode of the intervals between iteration edges arrived; an interval without episodes is left out.

    Takes the training episodes from the spawn in which the slab blocks the incumbent corridor; `trained` is a result of
    `train_navigator`.
    """
    update, slab, _, arrived = trained["episodes"].T  # (episodes,) each
    interval = np.digitize(update + 0.5, edges)
    parts = [arrived[(slab == incumbent) & (interval == k)] == 1 for k in range(1, len(edges))]
    return [part[None] for part in parts if len(part)] or [np.zeros((1, 1), bool)]


def alternative_success(trained: Result, incumbent: int, edges: Sequence[int] | np.ndarray) -> Int[np.ndarray, "k 2"]:
    """Successes and episodes in each of the k intervals between k + 1 iteration edges.

    Counts the training episodes from the spawn in which the slab blocks the incumbent corridor; `trained` is a result
    of `train_navigator`.
    """
    update, slab, _, arrived = trained["episodes"].T  # (episodes,) each
    kept = slab == incumbent
    counts = [np.histogram(update[kept] + 0.5, edges, weights=w)[0] for w in (arrived[kept], None)]
    return np.column_stack(counts).astype(np.int64)
