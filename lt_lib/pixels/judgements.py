"""The verdicts of the pixel study: rows of Table III, collapsed seeds, cells of Table IV.

Samples are arrays (seeds, episodes) as in `report.judges`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from lt_lib.comm.messages import CONDITIONS
from lt_lib.pixels.redraw import REDRAWS
from lt_lib.report import judges, stats
from lt_lib.report.shares import SOLVED
from lt_lib.report.stats import ALPHA, Outcomes
from lt_lib.store.run import Result

COLLAPSED = 10**-5.5  # nats: decision entropies whose nearest power of ten is at most the paper's 1e-6
ENTERED = (0.35, 0.65)  # route optimality of a destroyed cell: a coin of 256 tosses leaves it once in a million
LONGER = 1.5  # times the intact episode's length


def table_3(name: str) -> tuple[Callable[..., dict[str, Any]], tuple[str, ...]]:
    """The judge of a condition of Table III, and the conditions that it is compared with.

    ours, diagnostic        above the floor
    upper bound             below the latent: the paper finds the raw image less reliable
    lower bound, kinematic  at chance
    """
    match CONDITIONS[name].role:
        case "ours" | "diagnostic":
            return partial(judges.above, of="the floor"), ("floor",)
        case "upper bound":
            return partial(judges.below, of="the latent"), ("latent",)
    return judges.at_chance, ()


def lower_block(name: str) -> tuple[Callable[..., dict[str, Any]], str]:
    """The judge of a redrawn row, and what it is compared with: one draw of the same content, or the floor."""
    if REDRAWS[name].every:
        return partial(judges.below, of="one draw of the same content"), REDRAWS[name].content
    return partial(judges.above, of="the floor"), "floor"


def entropy_collapse(entropy: Float[np.ndarray, " seeds"], shares: Float[np.ndarray, " seeds"]) -> dict[str, Any]:
    """Seeds that stay unsolved with an entropy (nats) of the paper's order; holds if there are some, but not all."""
    stuck = (entropy <= COLLAPSED) & (shares < SOLVED)
    return {
        "value": f"{stuck.sum()} of {len(stuck)}",
        "n": len(stuck),
        "test": "unsolved, with a final decision entropy of 1e-6 nats or nearest to it: "
        + ", ".join(f"{each:.1g}" for each in entropy),
        "holds": bool(0 < stuck.sum() < len(stuck)),
    }


def destroyed(intact: Outcomes, cell: Outcomes) -> dict[str, Any]:
    """A cell of Table IV: destroying the wire costs every head its choice and leaves it at chance.

    Intact and destroyed episodes of a head share their draws, so each head is tested by pairs (McNemar).
    """
    p = max(stats.paired_change(*pair) for pair in zip(intact, cell, strict=True))
    shares = cell.mean(axis=1)
    lower = bool((shares < intact.mean(axis=1)).all())
    (low, high), inside = ENTERED, bool(ENTERED[0] <= shares.min() and shares.max() <= ENTERED[1])
    return judges.estimate(cell) | {
        "test": f"McNemar's exact test of every head, the largest p; each head within {low} to {high}",
        "p": p,
        "holds": p < ALPHA and lower and inside,
    }


def one_corridor(routes: Shaped[np.ndarray, "heads episodes"]) -> dict[str, Any]:
    """Whether every head takes one corridor in every episode."""
    constant = bool((routes == routes[:, :1]).all())
    return {
        "value": "constant" if constant else "varies",
        "test": "every head takes one corridor in every episode",
        "holds": constant,
        "n": len(routes),
    }


def longer(intact: Float[np.ndarray, "heads episodes"], zeroed: Float[np.ndarray, "heads episodes"]) -> dict[str, Any]:
    """The range over heads of mean episode length under zeroed content; every head's must be LONGER than intact."""
    p = max(float(stats.longer_mean(without, LONGER * with_)) for with_, without in zip(intact, zeroed, strict=True))
    means = zeroed.mean(axis=1)
    errors = 1.96 * zeroed.std(axis=1, ddof=1) / np.sqrt(zeroed.shape[1])
    first, last = means.argmin(), means.argmax()
    return {
        "value": (means[first], means[last]),
        "low": (means[first] - errors[first], means[last] - errors[last]),
        "high": (means[first] + errors[first], means[last] + errors[last]),
        "seeds": means,
        "test": f"Welch's test of every head: longer than {LONGER} times intact; the largest p",
        "p": p,
        "holds": p < ALPHA,
    }


def both_routes(routes: Shaped[np.ndarray, "seeds episodes"], batch: int) -> dict[str, Any]:
    """Whether every batch holds both routes in equal proportion until the head learns: the first batch of every seed.

    It holds if each seed's share lies where a fair coin's would and all of them together are near one half.
    """
    first = routes[:, :batch]
    slack = stats.coin_slack(len(first), first.shape[1])
    shares = first.mean(axis=1)
    p = stats.equivalence(first, 0.5, judges.AT_CHANCE)
    inside = bool((np.abs(shares - 0.5) <= slack).all())
    test = f"first batch: each seed within 0.5 ± {slack:.2f}, equivalence of all with 0.5 ± {judges.AT_CHANCE}"
    return judges.words(inside and p < ALPHA, test, p=p, n=len(first))


def earlier(one: Sequence[Result], other: Sequence[Result], batch: int) -> dict[str, Any]:
    """Episodes until a batch first reaches SOLVED, of two conditions, as words for a row of ours."""
    reached = [[episodes_until_solved(seed["optimal"], batch) for seed in side] for side in (one, other)]
    p = stats.rank_test(reached[1], reached[0])
    medians = [float(np.median(side)) for side in reached]
    return {
        "value": f"{medians[0]:,.0f} against {medians[1]:,.0f} episodes",
        "test": "exact rank test of episodes until a batch reaches 0.9",
        "p": p,
        "n": len(reached[0]),
    }


def episodes_until_solved(optimal: Bool[np.ndarray, " episodes"], batch: int) -> int:
    """Training episodes until a batch's route optimality first reaches SOLVED; all of them if none does."""
    whole = len(optimal) // batch
    shares = optimal[: whole * batch].reshape(whole, batch).mean(axis=1)
    solved = np.flatnonzero(shares >= SOLVED)
    return int((solved[0] + 1) * batch) if len(solved) else len(optimal)
