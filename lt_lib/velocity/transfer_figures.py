"""Figures and judgements of the direct transfer to velocity control (Section From Grid Actions)."""

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from matplotlib.figure import Figure

from lt_lib.envs.layout import SIDES
from lt_lib.report import stats
from lt_lib.report.style import ROLES, chance_line
from lt_lib.store.run import Result
from lt_lib.velocity.coverage import EVERY
from lt_lib.velocity.navigator import LATERAL
from lt_lib.velocity.transfer import DIRECT, Examined

COMMITTED = 0.95  # least share of one corridor, under either placement, of a navigator that has committed to it
OTHERS = {"oracle": "diagnostic", "silent": "lower bound", "no choice": "upper bound", "shown both mouths": "kinematic"}
COLOURS = {name: ROLES["ours"] for name in DIRECT} | {name: ROLES[role] for name, role in OTHERS.items()}


def null(evaluated: Mapping[str, Sequence[Result]]) -> Figure:
    """Route optimality of every navigator as it explores, and which corridor it enters under either placement."""
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    bars = [(name, result) for name, results in evaluated.items() for result in results]
    for x, (name, result) in enumerate(bars):
        chosen, colour = optimal(result), COLOURS[name]
        low, high = stats.wilson(chosen.sum(), len(chosen))
        mean = chosen.mean()
        upper.errorbar(x, mean, [[mean - low], [high - mean]], fmt="o", color=colour, capsize=4)
        for slab, shift in ((0, -0.17), (1, 0.17)):
            first = result["first"][0][result["slab"][0] == slab]
            shares = [(first == side).mean() if len(first) else 0.0 for side in (0, 1)]
            lower.bar(x + shift, shares[0], 0.3, color=ROLES["ours"])
            lower.bar(x + shift, shares[1], 0.3, bottom=shares[0], color=ROLES["upper bound"])
    chance_line(upper)
    upper.set(ylim=(-0.03, 1.05), ylabel="route optimality")
    lower.set(ylim=(0, 1.05), ylabel="first corridor entered\n(blue left, orange right)")
    lower.set_xticks(range(len(bars)), [fill(name, 12) for name, _ in bars], fontsize=8)
    upper.set_title("A dot a training, Wilson's 95% interval. Lower pairs of bars: slab left, slab right", fontsize=11)
    return figure


def optimal(result: Result, row: int = 0) -> np.ndarray:
    """Per episode, whether the first corridor entered was the slab-free one; entering none is not."""
    return (result["first"][row] >= 0) & (result["first"][row] != result["slab"][row])


def commitment(result: Result, row: int = 0) -> tuple[int, float]:
    """The incumbent: the corridor entered first in most episodes; and least share under either placement."""
    first, slab = result["first"][row], result["slab"][row]
    incumbent = int((first == 1).sum() > (first == 0).sum())
    return incumbent, float(min((first[slab == s] == incumbent).mean() for s in np.unique(slab)))


def learning(trained: Mapping[str, Sequence[Result]], block: int) -> Figure:
    """Training episodes from the spawn: share entering the left corridor first, route optimality and arrivals."""
    figure = Figure(figsize=(15, 3.6), layout="constrained")
    panels = figure.subplots(1, len(trained), sharey=True)
    for axes, (name, results) in zip(panels, trained.items(), strict=True):
        for result in results:
            update, slab, first, arrived = result["episodes"].T
            blocks = np.arange(-(-len(result["boost"]) // block))
            for values, colour, style in (
                (first == 0, "0.6", "--"),
                ((first >= 0) & (first != slab), COLOURS[name], "-"),
                (arrived, "black", ":"),
            ):
                means = [values[update // block == b].mean() if b in update // block else np.nan for b in blocks]
                axes.plot((blocks + 0.5) * block, means, color=colour, ls=style, lw=1.4)
        chance_line(axes)
        axes.set_title(fill(name, 12), fontsize=9)
        axes.set_xlabel("iteration", fontsize=8)
    panels[0].set(ylim=(-0.03, 1.05), ylabel="share of episodes")
    figure.suptitle("Solid: route optimality. Dashed: entered the left corridor first. Dotted: arrived", fontsize=10)
    return figure


def table(examined: Examined, trained: Mapping[str, Sequence[Result]]) -> pd.DataFrame:
    """A line a training: route optimality and success as it explores and without noise, commitment, lateral noise."""
    lines = []
    for name, results in examined.spawn.items():
        for result, mouths, navigator in zip(results, examined.mouths[name], trained[name], strict=True):
            incumbent, share = commitment(result)
            free = result["slab"][1] != incumbent
            lines.append(
                {
                    "training": name,
                    "route optimality": optimal(result).mean(),
                    "success": result["success"][0].mean(),
                    "incumbent": SIDES[incumbent],
                    "least share": share,
                    "success, incumbent free": result["success"][1][free].mean() if free.any() else np.nan,
                    "from the left mouth": mouths[0]["success"].mean(),
                    "from the right mouth": mouths[1]["success"].mean(),
                    "lateral sigma": navigator["sigma"][-1, LATERAL],
                }
            )
    return pd.DataFrame(lines).set_index("training").round(3)


def held_command(result: Result, step: float, window: int) -> float:
    """Mean sideways command toward the incumbent over the approach, without noise, as a share of full command.

    Read off the kept paths: metres moved sideways in the first `window` control steps over what full command covers.
    """
    points = min(window // EVERY, result["path"].shape[-2] - 1)
    moved = result["path"][1][:, points, 1] - result["path"][1][:, 0, 1]
    return float(np.abs(np.nanmean(moved)) / (step * points * EVERY))


def arrivals(result: Result) -> tuple[int, int]:
    """(successes, episodes) where the slab leaves the incumbent corridor free, actions sampled."""
    free = result["slab"][0] != commitment(result)[0]
    return int(result["success"][0][free].sum()), int(free.sum())


def as_pair(shares: np.ndarray) -> tuple[float, float]:
    """The least and the largest of some seeds."""
    return float(shares.min()), float(shares.max())


def silent(result: Result) -> dict[str, Any]:
    """Route optimality without a message as a finding: Wilson's interval, and whether it has committed."""
    chosen = optimal(result)
    low, high = stats.wilson(chosen.sum(), len(chosen))
    holds = commitment(result)[1] >= COMMITTED
    found = {"value": chosen.mean(), "low": low, "high": high, "n": len(chosen)}
    return found | {"test": "committed to one corridor", "holds": holds}


class Diagnosis(NamedTuple):
    """What the bit does to each oracle-bit navigator without noise."""

    shift: Float[np.ndarray, "seeds 2"]  # of the lateral mean if the bit flips, policy sds: approach, whole episode
    incumbent: Float[np.ndarray, " seeds"]  # share entering the incumbent first, both placements and both bits
    succeeded: Int[np.ndarray, "seeds 2"]  # incumbent corridor free: told the truth, told the opposite
    free: int  # episodes behind each of those counts
    episodes: int  # over all seeds, placements and bits


def bit_diagnosis(flips: Mapping[tuple[str, bool], Sequence[Result]], incumbents: Sequence[int]) -> Diagnosis:
    """From `Examined.flips` and every seed's incumbent corridor."""
    shift = [np.concatenate([r[i]["shift"][0] for r in flips.values()]).mean(0) for i in range(len(incumbents))]
    first = [np.concatenate([r[i]["first"][0] for r in flips.values()]) == side for i, side in enumerate(incumbents)]
    succeeded = [
        [flips[SIDES[1 - side], true][i]["success"][0].sum() for true in (True, False)]
        for i, side in enumerate(incumbents)
    ]
    free = flips[SIDES[0], True][0]["success"].size
    return Diagnosis(np.array(shift), np.mean(first, axis=1), np.array(succeeded, np.int64), free, sum(map(len, first)))


def bit_table(diagnosis: Diagnosis) -> pd.DataFrame:
    """A line an oracle-bit navigator."""
    columns = {
        "shift of the lateral mean, approach (sd)": diagnosis.shift[:, 0],
        "whole episode (sd)": diagnosis.shift[:, 1],
        "enters the incumbent": diagnosis.incumbent,
        "success, true bit": diagnosis.succeeded[:, 0] / diagnosis.free,
        "success, flipped bit": diagnosis.succeeded[:, 1] / diagnosis.free,
    }
    return pd.DataFrame(columns, index=pd.Index(range(len(diagnosis.shift)), name="seed")).round(3)


def judge_bit(diagnosis: Diagnosis) -> dict[str, Any]:
    """Success told the truth and told the opposite as a finding, pooled counts, Fisher's exact test of a fall."""
    true, flipped = map(int, diagnosis.succeeded.sum(axis=0))
    n = diagnosis.free * len(diagnosis.succeeded)
    p = stats.drop_test(true, flipped, n)
    low, high = np.transpose([stats.wilson(count, n) for count in (true, flipped)])
    found = {"value": (true / n, flipped / n), "low": low, "high": high, "n": n}
    return found | {"test": "Fisher's exact test, flipped below true", "p": p, "holds": bool(p < 0.05)}
