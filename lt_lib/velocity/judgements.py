"""Estimates and judgements on frozen and boosted navigators (Section From Grid Actions to Velocity Commands).

A result is one of `coverage.roll_navigator` or, where the name says so, of `navigator.train_navigator`.
"""

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import rankdata, spearmanr

from lt_lib.envs.layout import SIDES
from lt_lib.settings.velocity import Boost, RolloutConfig
from lt_lib.store.run import Result
from lt_lib.velocity.coverage import EVERY

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


def held_command(result: Result, step: float, window: int) -> float:
    """Mean sideways command during the approach, without noise (row 1), as a share of full command.

    It is read off the recorded paths: metres moved sideways in the first `window` control steps, divided by what full
    command would cover.

    step    metres that one control step of full command covers
    window  control steps
    """
    across = result["path"][1][..., 1]  # (episodes, points): y in metres
    points = min(window // EVERY, across.shape[1] - 1)
    return float(np.abs(np.nanmean(across[:, points] - across[:, 0])) / (step * points * EVERY))


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
    incumbent: Float[np.ndarray, " seeds"]  # share that enters the incumbent first, over both placements and both bits
    succeeded: Int[np.ndarray, "seeds 2"]  # successes with the incumbent free: true bit, flipped bit
    free: int  # episodes behind each of these counts
    episodes: int  # over all seeds, placements and bits


def bit_diagnosis(flips: Mapping[tuple[str, bool], Sequence[Result]], incumbents: Sequence[int]) -> Diagnosis:
    """Diagnoses the bit from `transfer.Examined.flips` and the incumbent corridor of each seed."""
    shift = [np.concatenate([r[i]["shift"][0] for r in flips.values()]).mean(0) for i in range(len(incumbents))]
    first = [np.concatenate([r[i]["first"][0] for r in flips.values()]) == side for i, side in enumerate(incumbents)]
    succeeded = [
        [flips[SIDES[1 - side], truthful][i]["success"][0].sum() for truthful in (True, False)]
        for i, side in enumerate(incumbents)
    ]
    free = flips[SIDES[0], True][0]["success"].size
    return Diagnosis(np.array(shift), np.mean(first, axis=1), np.array(succeeded, np.int64), free, sum(map(len, first)))


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


def alternative_success(trained: Result, incumbent: int, edges: Sequence[int] | np.ndarray) -> Int[np.ndarray, "k 2"]:
    """Successes and episodes in each of the k intervals between k + 1 iteration edges.

    Counts the training episodes from the spawn in which the slab blocks the incumbent corridor; `trained` is a result
    of `train_navigator`.
    """
    update, slab, _, arrived = trained["episodes"].T  # (episodes,) each
    kept = slab == incumbent
    counts = [np.histogram(update[kept] + 0.5, edges, weights=w)[0] for w in (arrived[kept], None)]
    return np.column_stack(counts).astype(np.int64)


def success_range(counts: Int[np.ndarray, "k 2"]) -> tuple[float, float]:
    """The smallest and the largest success over intervals; those without episodes are ignored, (0, 0) if all are."""
    shares = [successes / episodes for successes, episodes in counts if episodes] or [0.0]
    return min(shares), max(shares)
