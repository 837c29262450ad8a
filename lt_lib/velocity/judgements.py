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
PRINTED = 0.005  # the smallest share that does not print as 0.00
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


def held_near(across: Float[np.ndarray, "seeds episodes"], *, d: float) -> dict[str, Any]:
    """Whether the mean sideways command held is near d: within a fifth of it, so that the other side is near 2 d."""
    p = stats.equivalence(across, d, 0.2 * d)
    test = f"equivalence of the held command {across.mean():.2f} with d = {d:.2f} ± a fifth (TOST)"
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


def drives_and_commits(spawn: Result, mouths: Sequence[Result]) -> float:
    """How well a navigator drives either corridor and yet holds on to one: what a curriculum is chosen by.

    The success from in front of the worse mouth, that corridor free, times the least share of one corridor from the
    spawn; it never looks at coverage.
    """
    return min(mouth["success"].mean() for mouth in mouths) * commitment(spawn)[1]


# --- coverage
def sweep_row(
    covered: Bool[np.ndarray, "seeds episodes"],
    succeeded: Bool[np.ndarray, "seeds episodes"],
    *,
    side: str,
    coverage: float,
    competent: bool | None,
) -> dict[str, Any]:
    """A row of the sweep: coverage and success, tested for what the paper says of both (`coverage.STATED`).

    side, coverage  whether coverage must be 'above' or 'below' this share
    competent       whether success must be above COMPETENT, or below; None if the paper prints one half
    """
    sides = {"above": stats.mean_above, "below": stats.mean_below}
    tests = {f"coverage {side} {coverage}": sides[side](covered, coverage)}
    if competent is not None:
        where = "above" if competent else "below"
        tests[f"success {where} {COMPETENT}"] = sides[where](succeeded, COMPETENT)
    low, high = zip(stats.interval(covered), stats.interval(succeeded), strict=True)
    p = max(tests.values())
    return {
        "value": (covered.mean(), succeeded.mean()),
        "low": low,
        "high": high,
        "n": len(covered),
        "test": f"mean over seeds: {' and '.join(tests)}; the larger p",
        "p": p,
        "holds": p < ALPHA,
    }


def off_alternative(covered: Bool[np.ndarray, "..."], succeeded: Bool[np.ndarray, "..."]) -> float:
    """Success among the episodes that did not enter the alternative corridor; NaN if all entered it."""
    return float(succeeded[~covered].mean()) if not covered.all() else float("nan")


def opposed(*rows: Bool[np.ndarray, "seeds episodes"]) -> dict[str, Any]:
    """Whether coverage and success, both means over seeds, move in opposite directions over the rows of the sweep.

    Behind a solid slab an entry costs a success by construction, so the test takes success among the episodes that did
    not enter the alternative corridor.

    rows  the coverage of every row, then the success of every row
    """
    covered, succeeded = _halves(rows)
    coverage, success = (np.array([row.mean() for row in side]) for side in (covered, succeeded))
    through = np.nan_to_num([off_alternative(*pair) for pair in zip(covered, succeeded, strict=True)])
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


def only_where_collapsed(*rows: Bool[np.ndarray, "seeds episodes"]) -> dict[str, Any]:
    """Whether coverage becomes nonzero only at noise at which success has collapsed.

    It holds if some row is covered, and if in every row whose coverage prints as nonzero (0.005 or more) success is
    below COMPETENT (the largest p).

    rows  the coverage of every row, then the success of every row
    """
    reached = [succeeded for covered, succeeded in zip(*_halves(rows), strict=True) if covered.mean() >= PRINTED]
    p = max((stats.mean_below(row, COMPETENT) for row in reached), default=1.0)
    most = max((row.mean() for row in reached), default=0.0)
    test = f"in every row with coverage, success below {COMPETENT}; the largest is {most:.2f}"
    return judges.words(bool(reached) and p < ALPHA, test, p=p, n=len(rows[0]))


def _halves(rows: Sequence[Outcomes]) -> tuple[Sequence[Outcomes], Sequence[Outcomes]]:
    return rows[: len(rows) // 2], rows[len(rows) // 2 :]


def noise_reaches(covered: Bool[np.ndarray, "seeds episodes"]) -> dict[str, Any]:
    """Whether correlated noise in the window reaches the decision: coverage above RARE."""
    p = stats.mean_above(covered, RARE)
    return judges.words(p < ALPHA, f"coverage {covered.mean():.3f}, above {RARE} in the mean", p=p, n=len(covered))


def competence_destroyed(
    quiet: Bool[np.ndarray, "seeds episodes"], noisy: Bool[np.ndarray, "seeds episodes"]
) -> dict[str, Any]:
    """Whether noise over the whole episode destroys competence: success below COMPETENT, and below the quiet row's."""
    p = max(stats.mean_below(noisy, COMPETENT), stats.mean_less(noisy, quiet))
    test = f"success {noisy.mean():.2f}: below {COMPETENT} and below {quiet.mean():.2f}; the larger p"
    return judges.words(p < ALPHA, test, p=p, n=len(noisy))


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


def bit_diagnosis(flips: Sequence[Mapping[tuple[str, bool], Result]], incumbents: Sequence[int]) -> Diagnosis:
    """Diagnoses the bit from what `transfer.Bit` holds of every seed."""
    shift = [np.concatenate([r["shift"][0] for r in own.values()]).mean(0) for own in flips]
    pairs = list(zip(flips, incumbents, strict=True))
    first = [np.concatenate([r["first"][0] for r in own.values()]) == side for own, side in pairs]
    success = (np.stack([own[SIDES[1 - side], true]["success"][0] for own, side in pairs]) for true in (True, False))
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


def boost_opens(*blocks: Bool[np.ndarray, "seeds episodes"]) -> dict[str, Any]:
    """Alternative-corridor success with the boost, smallest and largest block; holds if all together exceed RARE."""
    p = stats.mean_above(np.concatenate(blocks, axis=1), RARE)
    return _range(blocks) | {"n": len(blocks[0]), "test": f"mean over seeds above {RARE}", "p": p, "holds": p < ALPHA}


def boost_fades(*blocks: Bool[np.ndarray, "seeds episodes"], early: int) -> dict[str, Any]:
    """The same of the late blocks, after so many early ones; holds if success is below the early blocks'."""
    first, last = (np.concatenate(part, axis=1) for part in (blocks[:early], blocks[early:]))
    p = stats.mean_less(last, first)
    return _range(blocks[early:]) | {
        "n": len(blocks[0]),
        "test": "mean over seeds, below early",
        "p": p,
        "holds": p < ALPHA,
    }


def _range(blocks: Sequence[Outcomes]) -> dict[str, Any]:
    """The smallest and the largest share of some blocks, with their intervals."""
    shares = [block.mean() for block in blocks]
    ends = [blocks[int(place)] for place in (np.argmin(shares), np.argmax(shares))]
    low, high = zip(*map(stats.interval, ends), strict=True)
    return {"value": (min(shares), max(shares)), "low": low, "high": high}


def alternative_outcomes(
    trained: Sequence[Result], incumbents: Sequence[int], edges: Sequence[int] | np.ndarray
) -> list[Bool[np.ndarray, "seeds episodes"]]:
    """Whether each episode between iteration edges arrived, one array per interval; an empty interval is left out.

    Takes the training episodes from the spawn in which the slab blocks the incumbent corridor; of seeds with more
    episodes than another, the last ones are dropped. `trained` are results of `train_navigator`.
    """
    by_seed = []
    for result, incumbent in zip(trained, incumbents, strict=True):
        update, slab, _, arrived = result["episodes"].T  # (episodes,) each
        interval = np.digitize(update + 0.5, edges)
        by_seed.append([arrived[(slab == incumbent) & (interval == k)] == 1 for k in range(1, len(edges))])
    blocks = []
    for parts in zip(*by_seed, strict=True):
        shortest = min(map(len, parts))
        if shortest:
            blocks.append(np.stack([part[:shortest] for part in parts]))
    return blocks or [np.zeros((len(trained), 1), bool)]


def alternative_success(trained: Result, incumbent: int, edges: Sequence[int] | np.ndarray) -> Int[np.ndarray, "k 2"]:
    """Successes and episodes in each of the k intervals between k + 1 iteration edges.

    Counts the training episodes from the spawn in which the slab blocks the incumbent corridor; `trained` is a result
    of `train_navigator`.
    """
    update, slab, _, arrived = trained["episodes"].T  # (episodes,) each
    kept = slab == incumbent
    counts = [np.histogram(update[kept] + 0.5, edges, weights=w)[0] for w in (arrived[kept], None)]
    return np.column_stack(counts).astype(np.int64)
