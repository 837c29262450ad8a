"""Figures and judgements of the redrawn route (lower block of Table III)."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from lt_lib.pixels.figures import final_shares
from lt_lib.pixels.redraw import REDRAWS
from lt_lib.report import stats
from lt_lib.report.style import ROLES, chance_line
from lt_lib.store.run import Result

# what stands beside a row to show what decides it: that row, a colour, and words
BESIDE = {
    "k30_gae": ("k30", ROLES["upper bound"], "discounted advantages (GAE)"),
    "k1_gae": ("k1", ROLES["upper bound"], "discounted advantages (GAE)"),
    "no bonus": ("k1", ROLES["diagnostic"], "no entropy bonus"),
}


def judge(name: str, shares: np.ndarray, once: np.ndarray, floor: np.ndarray) -> dict[str, Any]:
    """One cell of the lower block as a finding.

    once   seeds of the same content with one draw an episode: a redrawn row is tested to fall below them
    floor  seeds without a message: the row of one draw is tested to lie above them

    A test holds when no seed of one overlaps the other, as for the rows of the upper block.
    """
    low, high = stats.mean_interval(shares)
    finding = {"value": shares.mean(), "seeds": shares, "low": low, "high": high}
    above, below = (once, shares) if REDRAWS[name].every else (shares, floor)
    words = "below one draw of the same content" if REDRAWS[name].every else "above the floor"
    p, holds = stats.rank_test(above, below), bool(above.min() > below.max())
    return finding | {"test": f"exact rank test, {words}", "p": p, "holds": holds}


def fall_test(groups: Sequence[ArrayLike]) -> dict[str, Any]:
    """Whether the means fall from group to group, as a finding; it holds when no seed overlaps the group before.

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


def agreement(live: Mapping[str, Sequence[Result]], bank: Sequence[Result]) -> pd.DataFrame:
    """Live trainings with one draw an episode beside the bank's of the same seeds: the share of episodes that agree."""
    rows = {
        (name, seed): {"episodes": len(mine["success"])}
        | {key: np.mean(mine[key] == kept[key][: len(mine[key])]) for key in ("optimal", "success", "length")}
        for name, results in live.items()
        for seed, (mine, kept) in enumerate(zip(results, bank, strict=False))
    }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis(["agrees with the bank in", "seed"])


def table(heads: Mapping[str, Sequence[Result]], paper: Mapping[str, Any]) -> pd.DataFrame:
    """The lower block of Table III, ours beside the paper's: mean +- standard deviation over seeds."""
    rows = []
    for name, results in heads.items():
        row = {"route drawn": _plain(name), "n": len(results)}
        for column, key, claim in (("route opt.", "optimal", "route"), ("task success", "success", "success")):
            shares, told = final_shares(results, key), paper[f"px.{name}.{claim}"]
            row[column] = f"{shares.mean():.3f} ± {shares.std(ddof=1):.3f}"
            row[f"{column}, paper"] = f"{told.paper:.3f} ± {told.sd:.3f}"
        row["control steps"] = f"{np.mean([head['length'][-500:].mean() for head in results]):.0f}"
        row["entropy of a draw"] = f"{np.mean([head['entropy'][-1] for head in results]):.3f}"
        rows.append(row)
    return pd.DataFrame(rows).set_index("route drawn")


def _plain(name: str) -> str:
    return REDRAWS[name].words.replace("$", "").replace("z_t", "z")


def routes(heads: Mapping[str, Sequence[Result]], paper: Mapping[str, Any]) -> Figure:
    """Route optimality by redraw rate; a dot a seed, a bar the mean, a diamond the paper's mean and s.d."""
    figure = Figure(figsize=(8.6, 4.6), layout="constrained")
    axes = figure.subplots()
    for x, (name, results) in enumerate(heads.items()):
        shares, colour, told = final_shares(results, "optimal"), ROLES[REDRAWS[name].role], paper[f"px.{name}.route"]
        axes.plot([x - 0.25, x + 0.25], [shares.mean()] * 2, color=colour, lw=2.5)
        axes.plot(x + np.linspace(-0.16, 0.16, len(shares)), shares, "o", color=colour, ms=7, mec="white", mew=0.8)
        axes.errorbar(x + 0.36, told.paper, told.sd, fmt="D", mfc="white", mec="black", ecolor="black", ms=6, capsize=3)
    chance_line(axes)
    axes.set_xticks(range(len(heads)), [REDRAWS[name].words.replace(", ", ",\n") for name in heads])
    axes.set(ylim=(0.0, 1.06), ylabel="route optimality\n(share of episodes whose first corridor was slab-free)")
    axes.set_title("Only k and the content differ. Dot: a seed; bar: our mean; diamond: the paper's mean ± s.d.")
    return figure


def curves(heads: Mapping[str, Sequence[Result]], batch: int) -> Figure:
    """Route optimality, episode length and entropy a draw over training, a column a row of the table, every seed."""
    figure = Figure(figsize=(12.5, 7.2), layout="constrained")
    panels = figure.subplots(3, len(heads), sharex=True, sharey="row", squeeze=False)
    for (upper, middle, lower), (name, results) in zip(panels.T, heads.items(), strict=True):
        colour = ROLES[REDRAWS[name].role]
        for head in results:
            episodes = np.arange(1, len(head["entropy"]) + 1) * batch
            upper.plot(episodes, _by_batch(head["optimal"], batch), color=colour, lw=1, alpha=0.8)
            middle.plot(episodes, _by_batch(head["length"], batch), color=colour, lw=1, alpha=0.8)
            lower.semilogy(episodes, np.maximum(head["entropy"], 1e-7), color=colour, lw=1, alpha=0.8)
        upper.set_title(REDRAWS[name].words, fontsize=10)
        chance_line(upper)
        lower.axhline(np.log(2), color="black", ls="--", lw=0.8)
        lower.set_xlabel("training episodes")
    _name_rows(panels[:, 0])
    return figure


def what_decides(heads: Mapping[str, Sequence[Result]], batch: int) -> Figure:
    """Route optimality and entropy of a draw over training, beside what else was tried; a column a row, every seed."""
    rows = list(dict.fromkeys(row for name, (row, _, _) in BESIDE.items() if name in heads))
    figure = Figure(figsize=(5.4 * len(rows) + 1, 6.6), layout="constrained")
    panels = figure.subplots(2, len(rows), sharex=True, sharey="row", squeeze=False)
    for (upper, lower), row in zip(panels.T, rows, strict=True):
        lines = {row: (row, ROLES["ours"], "whole episode return, entropy bonus (ours)")} | BESIDE
        for name, (beside, colour, words) in lines.items():
            if beside != row or name not in heads:
                continue
            for head in heads[name]:
                episodes = np.arange(1, len(head["entropy"]) + 1) * batch
                upper.plot(episodes, _by_batch(head["optimal"], batch), color=colour, lw=1.2, alpha=0.8)
                lower.plot(episodes, head["entropy"], color=colour, lw=1.2, alpha=0.8)
            lower.plot([], [], color=colour, label=words)
        upper.set(title=REDRAWS[row].words, ylim=(0.3, 1.03))
        chance_line(upper)
        lower.axhline(np.log(2), color="black", ls="--", lw=0.8)
        lower.legend(loc="lower left", fontsize=9)
        lower.set(xlabel="training episodes", ylim=(0, 0.72))
    panels[0, 0].set_ylabel("route optimality of a batch\ndotted: chance")
    panels[1, 0].set_ylabel("entropy of a draw (nats)\ndashed: uniform")
    return figure


def _by_batch(values: np.ndarray, batch: int) -> list[float]:
    return [part.mean() for part in np.array_split(values, np.arange(batch, len(values), batch))]


def _name_rows(first: Sequence[Axes]) -> None:
    first[0].set(ylabel="route optimality\nof a batch", ylim=(0.3, 1.03))
    first[1].set(ylabel="control steps\nan episode", ylim=(0, 620))
    first[2].set(ylabel="entropy of a draw (nats)\ndashed: uniform")
