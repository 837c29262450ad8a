"""Tables, figures and judgements of the corruption controls (Table IV).

`rows` below are what `Protocol.corrupted` gives for each head: {wire condition: arrays over episodes}.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lt_lib.comm.messages import CONDITIONS
from lt_lib.report import stats
from lt_lib.report.claims import Claim
from lt_lib.report.style import ROLES, chance_line
from lt_lib.store.run import Result

Rows = Sequence[Mapping[str, Result]]
IDS = {
    "intact": "intact",
    "content_zeroed": "content",
    "wire_zeroed": "wire",
    "sender_shuffled": "shuffle",
    "matched_noise": "noise",
}
AT_CHANCE = (0.35, 0.65)  # route optimality of a destroyed cell
ALPHA = 0.001  # of the drop, for every head


def claim_id(name: str, wire: str) -> str:
    return f"cor.{IDS[wire]}.{name}"


def shares(rows: Rows) -> dict[str, np.ndarray]:
    """Per wire condition, each head's greedy route optimality."""
    return {wire: np.array([row[wire]["optimal"].mean() for row in rows]) for wire in rows[0]}


def papers(claims: Mapping[str, Claim]) -> dict[str, dict[str, float]]:
    return {name: {wire: claims[claim_id(name, wire)].paper for wire in IDS} for name in ("latent", "oracle")}


def mean_lengths(rows: Rows, wire: str) -> np.ndarray:
    """Each head's mean episode length, control steps."""
    return np.array([row[wire]["length"].mean() for row in rows])


def always_one_corridor(rows: Rows, wire: str = "content_zeroed") -> bool:
    """Whether every head makes the same choice in all its episodes."""
    return all(len(np.unique(row[wire]["route"])) == 1 for row in rows)


def judge(rows: Rows, wire: str) -> dict[str, Any]:
    """One cell as a finding; a destroyed wire must cost every head its choice and leave it at chance."""
    cell = np.array([row[wire]["optimal"].mean() for row in rows])
    finding = {"value": cell.mean(), "seeds": cell}
    if len(cell) > 1:
        finding["low"], finding["high"] = stats.mean_interval(cell)
    else:
        finding["low"], finding["high"] = stats.wilson(rows[0][wire]["optimal"].sum(), rows[0][wire]["optimal"].size)
    if wire == "intact":
        return finding
    counts = [(row["intact"]["optimal"].sum(), row[wire]["optimal"].sum(), row[wire]["optimal"].size) for row in rows]
    p = max(stats.drop_test(*count) for count in counts)
    (low, high), spread = AT_CHANCE, 1.96 * 0.5 / np.sqrt(counts[0][2])
    holds = bool(p < ALPHA and low <= cell.min() and cell.max() <= high)
    return finding | {
        "test": "Fisher exact drop from intact, largest p of the heads; each within 0.35 to 0.65",
        "p": p,
        "holds": holds,
        "note": f"at chance a head's episodes alone scatter by ±{spread:.2f}",
    }


def table(cells: Mapping[str, Mapping[str, np.ndarray]], claims: Mapping[str, Claim]) -> pd.DataFrame:
    """Table IV, ours beside the paper's: mean and range over heads."""
    rows = {}
    for wire in IDS:
        row = {}
        for name, by_wire in cells.items():
            values, told = by_wire[wire], claims[claim_id(name, wire)]
            row[name] = f"{values.mean():.3f}" + (
                f" ({values.min():.3f} to {values.max():.3f})" if len(values) > 1 else ""
            )
            row[f"{name}, paper"] = f"{told.paper:.3f}" + (
                f" ({told.range[0]:.3f} to {told.range[1]:.3f})" if told.range else ""
            )
        rows[wire.replace("_", " ")] = row
    return pd.DataFrame(rows).T


def left_shares(cells: Mapping[str, Rows]) -> pd.DataFrame:
    """Share of episodes in which each head took the left corridor, by wire condition."""
    columns = {
        f"{name} {i}": {wire: 1 - row[wire]["route"].mean() for wire in row}
        for name, rows in cells.items()
        for i, row in enumerate(rows)
    }
    return pd.DataFrame(columns).rename(index=lambda wire: wire.replace("_", " ")).round(3)


def dots(cells: Mapping[str, Mapping[str, np.ndarray]], paper: Mapping[str, Mapping[str, float]]) -> Figure:
    """Greedy route optimality by wire condition; a dot a head, diamonds the paper's means."""
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    axes = figure.subplots()
    for offset, (name, row) in zip((-0.16, 0.16), cells.items(), strict=True):
        colour = ROLES[CONDITIONS[name].role]
        for x, (wire, values) in enumerate(row.items()):
            spread = np.linspace(-0.06, 0.06, len(values)) if len(values) > 1 else 0
            axes.plot(x + offset + spread, values, "o", color=colour, ms=7, mec="white")
            axes.plot(x + offset + 0.13, paper[name][wire], "D", mfc="white", mec=colour, ms=6)
        axes.plot([], [], "o", color=colour, label=f"{name} head")
    axes.plot([], [], "D", mfc="white", mec="black", label="the paper's mean")
    chance_line(axes)
    axes.set_xticks(range(len(IDS)), [wire.replace("_", "\n") for wire in IDS])
    axes.set(ylim=(0, 1.06), ylabel="greedy route optimality", xlabel="what happens to the wire at evaluation")
    axes.legend(loc="upper right", fontsize=9)
    return figure


def lengths(rows: Rows) -> Figure:
    """Histograms of episode length, all heads together, by wire condition."""
    figure = Figure(figsize=(11, 2.8), layout="constrained")
    panels = figure.subplots(1, len(IDS), sharex=True, sharey=True)
    for axes, wire in zip(panels, IDS, strict=True):
        values = np.concatenate([row[wire]["length"] for row in rows])
        axes.hist(
            values,
            bins=np.arange(0, 625, 25),
            weights=np.full(len(values), 1 / len(values)),
            color=ROLES["ours"],
        )
        axes.axvline(values.mean(), color="black", lw=1.2)
        axes.set_title(f"{wire.replace('_', ' ')}\nmean {values.mean():.0f}", fontsize=9)
        axes.set_xlabel("control steps")
    panels[0].set_ylabel("share of episodes")
    return figure
