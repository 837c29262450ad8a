"""Figures and judgements of the pixel experiments (Table III, Fig. 4, Table IV)."""

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lt_lib.comm.messages import CONDITIONS
from lt_lib.report import stats
from lt_lib.report.style import ROLES, chance_line
from lt_lib.store.run import Result

SOLVED = 0.9  # route optimality from which a seed counts as solved, as in the paper's 2 of 3 raw seeds near 0.95
COLLAPSED = 1e-3  # nats of decision entropy below which a head no longer explores
ALPHA = 0.05


def final_shares(heads: Sequence[Result], name: str, last: int = 500) -> np.ndarray:
    """Per seed, the mean of 'optimal' or 'success' over the last training episodes: the head's sampled choices."""
    return np.array([head[name][-last:].mean() for head in heads])


def collapsed(head: Result) -> bool:
    """Whether a head stopped exploring and stayed at chance."""
    return bool(head["entropy"][-1] < COLLAPSED and final_shares([head], "optimal")[0] < SOLVED)


def judge(name: str, shares: np.ndarray, floor: np.ndarray, latent: np.ndarray) -> dict[str, Any]:
    """One cell of Table III as a finding: value, seeds, interval, and the test that its role calls for.

    ours, diagnostic       above the floor, exact one-sided rank test
    lower bound, kinematic  at chance, equivalence within +- 0.1
    upper bound            no better than the latent, exact one-sided rank test that it falls short
    """
    low, high = stats.mean_interval(shares)
    finding = {"value": shares.mean(), "seeds": shares, "low": low, "high": high}
    match CONDITIONS[name].role:
        case "ours" | "diagnostic":
            p = stats.rank_test(shares, floor)
            return finding | {
                "test": "exact rank test, above the floor",
                "p": p,
                "holds": bool(shares.min() > floor.max()),
            }
        case "upper bound":
            p = stats.rank_test(latent, shares)
            return finding | {
                "test": "exact rank test, latent above it; holds if no better",
                "p": p,
                "holds": bool(shares.mean() <= latent.mean()),
                "note": f"{(shares >= SOLVED).sum()} of {len(shares)} seeds solved, the paper's 2 of 3 decide its mean",
            }
    p = stats.chance_equivalence(shares)
    return finding | {"test": "equivalence with chance +- 0.1 (TOST)", "p": p, "holds": p < ALPHA}


def table(heads: Mapping[str, Sequence[Result]], paper: Mapping[str, Any]) -> pd.DataFrame:
    """Table III, ours beside the paper's where it has the row: mean +- standard deviation over seeds."""
    rows = []
    for name, results in heads.items():
        row = {"message content": CONDITIONS[name].words.replace("$", ""), "n": len(results)}
        row["message content"] = {"latent": "latent z", "predicted": "predicted z-hat"}.get(
            name, row["message content"]
        )
        for column, key, claim in (
            ("route opt.", "optimal", "route"),
            ("task success", "success", "success"),
        ):
            shares, told = final_shares(results, key), paper.get(f"px.{name.replace('_', '')}.{claim}")
            row[column] = f"{shares.mean():.3f} ± {shares.std(ddof=1):.3f}"
            row[f"{column}, paper"] = f"{told.paper:.3f} ± {told.sd:.3f}" if told else ""
        rows.append(row)
    return pd.DataFrame(rows).set_index("message content")


def _wrapped(name: str) -> str:
    """A condition's words in lines that do not reach the next one's."""
    return fill(CONDITIONS[name].words, 15, break_long_words=False)


def routes(heads: Mapping[str, Sequence[Result]], paper: Mapping[str, Any]) -> Figure:
    """Fig. 4: route optimality by message content; a dot a seed, a bar the mean, a diamond the paper's mean."""
    figure = Figure(figsize=(10, 4.8), layout="constrained")
    axes = figure.subplots()
    for x, (name, results) in enumerate(heads.items()):
        shares, colour = final_shares(results, "optimal"), ROLES[CONDITIONS[name].role]
        spread = np.linspace(-0.16, 0.16, len(shares))
        axes.plot([x - 0.25, x + 0.25], [shares.mean()] * 2, color=colour, lw=2.5)
        axes.plot(x + spread, shares, "o", color=colour, ms=7, mec="white", mew=0.8)
        if told := paper.get(f"px.{name.replace('_', '')}.route"):
            axes.plot(x + 0.36, told.paper, "D", mfc="white", mec="black", ms=6)
    chance_line(axes)
    axes.set_xticks(range(len(heads)), [_wrapped(name) for name in heads], fontsize=9)
    axes.set(ylim=(0.0, 1.06), ylabel="route optimality\n(share of episodes in the slab-free corridor)")
    axes.set_title(
        "Only the message content differs. Dot: a seed; bar: our mean; hollow diamond: the paper's mean",
        fontsize=11,
    )
    for role, colour in ROLES.items():
        axes.plot([], [], "o", color=colour, label=role)
    axes.legend(loc="lower left", ncols=3, fontsize=9)
    return figure


def learning_curves(heads: Mapping[str, Sequence[Result]], batch: int) -> Figure:
    """Route optimality (a batch of episodes a point) and decision entropy over training, every seed drawn."""
    figure = Figure(figsize=(13, 5.2), layout="constrained")
    panels = figure.subplots(2, len(heads), sharex=True, sharey="row")
    for (upper, lower), (name, results) in zip(panels.T, heads.items(), strict=True):
        colour = ROLES[CONDITIONS[name].role]
        for head in results:
            episodes = np.arange(1, len(head["entropy"]) + 1) * batch
            chosen = np.array_split(head["optimal"], np.arange(batch, len(head["optimal"]), batch))
            upper.plot(episodes, [part.mean() for part in chosen], color=colour, lw=1, alpha=0.8)
            lower.semilogy(episodes, np.maximum(head["entropy"], 1e-7), color=colour, lw=1, alpha=0.8)
        upper.set_title(_wrapped(name), fontsize=9)
        chance_line(upper)
        lower.axhline(np.log(2), color="black", ls="--", lw=0.8)
    panels[0, 0].set(ylabel="route optimality\nof a batch", ylim=(0.3, 1.03))
    panels[1, 0].set(ylabel="decision entropy (nats)\ndashed: uniform")
    for axes in panels[1]:
        axes.set_xlabel("episodes", fontsize=8)
    return figure


def executor_curve(executor: Result, batch: int) -> Figure:
    """Share of ended episodes that obeyed the commanded route, over pretraining."""
    figure = Figure(figsize=(7, 3.2), layout="constrained")
    axes = figure.subplots()
    ended = executor["curve.episodes"] > 0
    steps = np.arange(1, len(ended) + 1) * batch
    axes.plot(steps[ended] / 1e6, executor["curve.obedient"][ended], color=ROLES["ours"], lw=1.5)
    axes.set(xlabel="control steps (millions)", ylabel="obedient share\nof ended episodes", ylim=(-0.03, 1.03))
    axes.set_title("Executor pretraining: sampled actions, corridor commanded at random")
    return figure
