"""The scoreboard as one figure: the paper's value and ours for every measured claim that is a number."""

import textwrap
from collections.abc import Mapping
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lt_lib.report.claims import JUDGED, NOT_RUN, Claim, Number, numbers
from lt_lib.report.scoreboard import MARKS, Mark, printed, stamp, summary, told

ROW = 0.23  # inches per claim
SPREAD = 0.4  # rows spanned by the components of a list
WORDS = 78  # characters of a claim's text beside its row
WIDEST = 2.5  # right end of the ratio axis; an arrow there marks whatever lies beyond
PAPER = Line2D([], [], marker="D", color="black", mfc="white", ls="", ms=6, label="paper")


def figure(board: pd.DataFrame, claims: Mapping[str, Claim], profile: str) -> Figure:
    """The paper's values (hollow diamonds) and ours (filled, with 95% intervals), grouped by notebook.

    The upper panel holds proportions on an axis from 0 to 1, the lower one everything else as ours / paper. Components
    of a list share a row, one below the other. A stamp crosses the figure if the profile gives no verdicts.

    board   from `scoreboard.join`
    claims  those that the board was made from; their units separate the panels
    """
    rows = board[
        (board.kind == "measured")
        & (board.follows == "")
        & board.id.map(lambda name: numbers(claims[name].paper) is not None)
    ]
    units = rows.id.map(lambda name: claims[name].unit)
    panels = [rows.assign(unit=units)[units == ""], rows.assign(unit=units)[units != ""]]
    heights = [len(panel) + panel.notebook.nunique() for panel in panels]
    fig = Figure(figsize=(13, ROW * sum(heights) + 2.4), layout="constrained")
    upper, lower = fig.subplots(2, 1, height_ratios=heights)
    _forest(upper, panels[0])
    upper.set(xlim=(-0.02, 1.02), xlabel="proportion (dotted: 0.5)")
    upper.axvline(0.5, color="0.4", ls=":", lw=1, zorder=0.5)
    _forest(lower, panels[1])
    lower.set(xlim=(-0.05, WIDEST + 0.05), xlabel=f"ours / paper (arrow: beyond {WIDEST})")
    _legend(upper, board)
    title = ["Paper against ours: every measured number, once", summary(board), stamp(board, profile)]
    fig.suptitle("\n".join(textwrap.fill(line, 130) for line in title if line))
    if profile != JUDGED:
        for height in (0.25, 0.7):
            fig.text(0.5, height, f"{profile.upper()}: not a result", rotation=35, fontsize=64, alpha=0.12, ha="center")
    return fig


def _forest(axes: Axes, rows: pd.DataFrame) -> None:
    """Draws one panel: a heading per notebook, a row per claim, and both values in figures on the right."""
    labels, bold = [], []
    for notebook, part in rows.groupby("notebook"):
        bold.append(len(labels))
        axes.axhspan(len(labels) - 0.5, len(labels) + 0.5, color="0.93", lw=0, zorder=0)
        labels.append(notebook)
        for row in part.to_dict("records"):
            _claim(axes, row, len(labels))
            labels.append(f"{textwrap.shorten(row['what'], WORDS, placeholder=' ...')}   {row['id']}")
    axes.set_yticks(range(len(labels)), labels, fontsize=8)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", color="0.9", lw=0.6)
    axes.set_axisbelow(True)
    for place in bold:
        axes.get_yticklabels()[place].set_fontweight("bold")


def _claim(axes: Axes, row: Mapping[str, Any], y: Number) -> None:
    """Draws the diamonds, dots, intervals and figures of one claim."""
    mark = MARKS[row["verdict"]]
    papers = _components(row["paper"])
    ours = _components(row["ours"])
    if len(papers) < len(ours):  # several cases of ours beside one number of the paper
        papers = papers * len(ours)
    lows, highs = _components(row["low"]), _components(row["high"])
    for i, paper in enumerate(papers):
        at = y + (i / (len(papers) - 1) - 0.5) * SPREAD if len(papers) > 1 else y
        axes.plot(_place(paper, paper, row), at, marker="D", color="0.25", mfc="white", ms=6, ls="", zorder=2)
        if ours:
            interval = [_place(end[i], paper, row) for end in (lows, highs) if end]
            axes.plot(interval, [at] * len(interval), color=mark.colour, lw=1.6, zorder=1)
            _dot(axes, _place(ours[i], paper, row), at, mark)
    text = f"{printed(row['paper'])}  →  {printed(row['ours'])}" if ours else printed(row["paper"])
    side = {"transform": axes.get_yaxis_transform(), "va": "center", "fontsize": 7.5}
    axes.text(1.01, y, mark.sign, color=mark.colour, fontweight="bold", **side)
    axes.text(1.035, y, f"{text} {row['unit']}", color="0.5" if row["verdict"] == NOT_RUN else "black", **side)


def _dot(axes: Axes, x: Number, y: Number, mark: Mark) -> None:
    beyond = x >= WIDEST
    axes.plot(x, y, marker=">" if beyond else mark.marker, color=mark.colour, mec="white", mew=0.5, ms=7, zorder=3)


def _components(value: Any) -> tuple[Number, ...]:
    """The numbers in a cell of the board; none if it is empty."""
    if value is None:
        return ()
    return numbers(tuple(value) if isinstance(value, list) else value)


def _place(value: Number, paper: Number, row: Mapping[str, Any]) -> Number:
    """A number's place on its panel's axis: the number itself, or its ratio to the paper's (0 over 0 is 1)."""
    if not row["unit"]:
        return value
    if paper == 0:
        return 1.0 if value == 0 else WIDEST
    return min(value / paper, WIDEST)


def _legend(axes: Axes, board: pd.DataFrame) -> None:
    """Explains the marks that occur on the board, above the upper panel."""
    kinds = [kind for kind in MARKS if (board.verdict == kind).any() and kind != NOT_RUN]
    handles = [
        Line2D([], [], marker=MARKS[kind].marker, color=MARKS[kind].colour, lw=1.6, ms=7, label=told(kind))
        for kind in kinds
    ]
    axes.legend(handles=[PAPER, *handles], loc="lower center", bbox_to_anchor=(0.5, 1), ncols=6, frameon=False)
