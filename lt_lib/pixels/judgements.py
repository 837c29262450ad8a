"""The verdicts of the pixel study: cells of Table III and its redrawn rows, collapsed seeds, cells of Table IV."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lt_lib.comm.messages import CONDITIONS
from lt_lib.pixels.redraw import REDRAWS
from lt_lib.report import stats
from lt_lib.report.shares import SOLVED, final_shares
from lt_lib.store.run import Result

COLLAPSED = 1e-3  # nats of decision entropy below which a head no longer explores
ALPHA = 0.05
DROP_ALPHA = 0.001  # for the drop under a destroyed wire, for every head
AT_CHANCE = (0.35, 0.65)  # route optimality under a destroyed wire


def collapsed(head: Result) -> bool:
    """Whether a head stopped exploring and stayed at chance."""
    return bool(head["entropy"][-1] < COLLAPSED and final_shares([head], "optimal")[0] < SOLVED)


def judge_condition(name: str, shares: np.ndarray, floor: np.ndarray, latent: np.ndarray) -> dict[str, Any]:
    """A cell of Table III as a finding: value, seeds, interval, and the test that its role calls for.

    ours, diagnostic        above the floor, exact one-sided rank test
    lower bound, kinematic  at chance, equivalence within +- 0.1
    upper bound             no better than the latent, exact one-sided rank test that it falls short
    """
    low, high = stats.mean_interval(shares)
    finding = {"value": shares.mean(), "seeds": shares, "low": low, "high": high}
    match CONDITIONS[name].role:
        case "ours" | "diagnostic":
            p, holds = stats.rank_test(shares, floor), bool(shares.min() > floor.max())
            return finding | {"test": "exact rank test, above the floor", "p": p, "holds": holds}
        case "upper bound":
            return finding | {
                "test": "exact rank test, latent above it; holds if no better",
                "p": stats.rank_test(latent, shares),
                "holds": bool(shares.mean() <= latent.mean()),
                "note": f"{(shares >= SOLVED).sum()} of {len(shares)} seeds solved, the paper's 2 of 3 decide its mean",
            }
    p = stats.chance_equivalence(shares)
    return finding | {"test": "equivalence with chance +- 0.1 (TOST)", "p": p, "holds": p < ALPHA}


def judge_redrawn(name: str, shares: np.ndarray, once: np.ndarray, floor: np.ndarray) -> dict[str, Any]:
    """A cell of the redrawn rows as a finding; its test holds if the seeds of the two sides do not overlap.

    once   seeds of the same content with one draw per episode: a redrawn row must lie below them
    floor  seeds without a message: the row of one draw must lie above them
    """
    low, high = stats.mean_interval(shares)
    finding = {"value": shares.mean(), "seeds": shares, "low": low, "high": high}
    above, below = (once, shares) if REDRAWS[name].every else (shares, floor)
    words = "below one draw of the same content" if REDRAWS[name].every else "above the floor"
    p, holds = stats.rank_test(above, below), bool(above.min() > below.max())
    return finding | {"test": f"exact rank test, {words}", "p": p, "holds": holds}


def fall_test(groups: Sequence[ArrayLike]) -> dict[str, Any]:
    """Whether the means fall from group to group, as a finding; it holds if no seed overlaps the previous group.

    p is the largest of the steps' exact one-sided rank tests, since every step must be a fall.
    """
    steps = list(pairwise(groups))
    falls = all(np.mean(above) > np.mean(below) for above, below in steps)
    apart = all(np.min(above) > np.max(below) for above, below in steps)
    return {
        "value": "monotone" if falls else "not monotone",
        "test": "exact rank test of every step, the largest p",
        "p": max(stats.rank_test(above, below) for above, below in steps),
        "holds": apart,
        "note": "the means fall, but the seeds of two neighbouring rates overlap" if falls and not apart else "",
    }


def judge_corrupted(heads: Sequence[Mapping[str, Result]], wire: str) -> dict[str, Any]:
    """A cell of Table IV as a finding: a destroyed wire must cost every head its choice and leave it at chance.

    heads  per head, what `PixelProtocol.corrupted` returns: {wire condition: arrays over episodes}
    """
    cell = np.array([head[wire]["optimal"].mean() for head in heads])
    finding = {"value": cell.mean(), "seeds": cell}
    if len(cell) > 1:
        finding["low"], finding["high"] = stats.mean_interval(cell)
    else:
        finding["low"], finding["high"] = stats.wilson(heads[0][wire]["optimal"].sum(), heads[0][wire]["optimal"].size)
    if wire == "intact":
        return finding
    counts = [(h["intact"]["optimal"].sum(), h[wire]["optimal"].sum(), h[wire]["optimal"].size) for h in heads]
    p = max(stats.drop_test(*count) for count in counts)
    (low, high), spread = AT_CHANCE, 1.96 * 0.5 / np.sqrt(counts[0][2])
    return finding | {
        "test": "Fisher exact drop from intact, largest p of the heads; each within 0.35 to 0.65",
        "p": p,
        "holds": bool(p < DROP_ALPHA and low <= cell.min() and cell.max() <= high),
        "note": f"at chance a head's episodes alone scatter by ±{spread:.2f}",
    }
