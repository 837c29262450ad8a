"""The scoreboard in pictures: every verdict on one page, and the paper's numbers beside ours, a notebook at a time."""

import re
import textwrap
from collections.abc import Mapping
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyBboxPatch

from lt_lib.report.claims import JUDGED, NOT_RUN, Claim, Number, numbers
from lt_lib.report.front import TEMPLATES
from lt_lib.report.scoreboard import MARKS, Mark, independent, printed, told

WIDTH = 9  # inches of a page, so that its text can be read at half the size
ROW = 0.42  # inches per row
SPREAD = 0.44  # rows spanned by the components of a list
FEW = 3  # components of a list that have places of their own
WORDS = 36  # characters in a line of a label
WIDEST = 2.5  # right end of the ratio axis; an arrow there marks whatever lies beyond
PAPER = Line2D([], [], marker="D", color="black", mfc="white", ls="", ms=7, label="the paper")


def overview(board: pd.DataFrame, profile: str) -> Figure:
    """Every independent measured claim as a box with the sign of its verdict, a row per question of the paper."""
    facts = independent(board)
    questions, order = _questions(), {kind: i for i, kind in enumerate(MARKS)}
    rows = {name: sorted(part.verdict, key=order.get) for name, part in facts.groupby("notebook")}
    longest = max(map(len, rows.values()), default=1)
    figure = Figure(figsize=(WIDTH, 0.5 * len(rows) + 1.3), layout="constrained")
    axes = figure.subplots()
    for y, verdicts in enumerate(rows.values()):
        for x, kind in enumerate(verdicts):
            _box(axes, x, y, MARKS[kind])
        axes.text(longest + 0.4, y, _counts(verdicts), va="center", fontsize=13)
    axes.set(xlim=(-0.2, longest + 4.6 * longest / 30), ylim=(len(rows) - 0.4, -0.6), xticks=[])
    axes.set_yticks(range(len(rows)), [textwrap.fill(questions[name], 22) for name in rows], fontsize=12)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    _explain(figure, facts.verdict)
    _title(figure, facts, profile)
    return figure


def _questions() -> dict[str, str]:
    """What each notebook is about, as the README says it."""
    text = (TEMPLATES / "notebooks.md").read_text(encoding="utf-8")
    return {name: words for words, name in re.findall(r"^\| (.+?) \| \[[^]]+\]\((\w+)\)", text, re.MULTILINE)}


def _box(axes: Axes, x: int, y: int, mark: Mark) -> None:
    shape = {"boxstyle": "round,pad=0,rounding_size=0.12", "fc": mark.colour, "ec": "none"}
    axes.add_patch(FancyBboxPatch((x + 0.06, y - 0.32), 0.88, 0.64, **shape))
    axes.text(x + 0.5, y, mark.sign, color="white", ha="center", va="center", fontsize=11, fontweight="bold")


def _counts(verdicts: list[str]) -> str:
    return "  ".join(f"{verdicts.count(kind)} {MARKS[kind].sign}" for kind in dict.fromkeys(verdicts))


def _explain(figure: Figure, verdicts: pd.Series) -> None:
    """A legend of the verdicts that occur."""
    kinds = [kind for kind in MARKS if (verdicts == kind).any()]
    handles = [Line2D([], [], marker="s", color=MARKS[kind].colour, ls="", ms=11, label=told(kind)) for kind in kinds]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=12, frameon=False)


def _title(figure: Figure, facts: pd.DataFrame, profile: str) -> None:
    """What the board found, and a stamp across it if the profile gives no verdicts."""
    counts = facts.verdict.value_counts()
    parts = ", ".join(f"{counts[kind]} {kind or 'without a verdict'}" for kind in MARKS if kind in counts)
    figure.suptitle(f"Of {len(facts)} independent measured claims: {parts}", fontsize=14)
    _stamp(figure, profile)


def _stamp(figure: Figure, profile: str) -> None:
    if profile != JUDGED:
        figure.text(0.5, 0.5, f"{profile.upper()}: not a result", rotation=20, fontsize=40, alpha=0.13, ha="center")


def shown(board: pd.DataFrame, claims: Mapping[str, Claim]) -> pd.DataFrame:
    """The measured rows whose numbers a figure shows: none that follows from another."""
    told_in_numbers = board.id.map(lambda name: numbers(claims[name].paper) is not None)
    return board[(board.kind == "measured") & (board.follows == "") & told_in_numbers]


def figure(rows: pd.DataFrame, claims: Mapping[str, Claim], profile: str) -> Figure:
    """The paper's values (hollow diamonds) beside ours (filled, with 95% intervals), a row per claim.

    The upper panel holds proportions on an axis from 0 to 1, the lower one everything else as ours / paper. A stamp
    crosses the figure if the profile gives no verdicts.

    rows    of one notebook, from `shown`
    claims  those that the board was made from; their units separate the panels
    """
    units = rows.id.map(lambda name: claims[name].unit)
    panels = [
        part for part in (rows.assign(unit=units)[units == ""], rows.assign(unit=units)[units != ""]) if len(part)
    ]
    fig = Figure(figsize=(WIDTH, ROW * len(rows) + 1.0 * len(panels) + 0.9), layout="constrained")
    axes_of = fig.subplots(len(panels), 1, squeeze=False, height_ratios=[len(part) + 0.5 for part in panels])
    for axes, part in zip(axes_of[:, 0], panels, strict=True):
        axes.set_gid("ratio" if part.unit.iloc[0] else "share")
        _forest(axes, part)
    fig.get_layout_engine().set(h_pad=0.1)
    _legend(fig, rows)
    _stamp(fig, profile)
    return fig


def _forest(axes: Axes, rows: pd.DataFrame) -> None:
    """Draws one panel, with both values in figures on the right."""
    for y, row in enumerate(rows.to_dict("records")):
        _claim(axes, row, y)
    axes.set_yticks(range(len(rows)), [_label(row) for row in rows.what], fontsize=10)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", color="0.9", lw=0.6)
    axes.set_axisbelow(True)
    if axes.get_gid() == "share":
        axes.set(xlim=(-0.02, 1.02), xlabel="share (dotted: one half)")
        axes.axvline(0.5, color="0.4", ls=":", lw=1, zorder=0.5)
    else:
        axes.set(xlim=(-0.05, WIDEST + 0.05), xlabel=f"ours / paper (arrow: beyond {WIDEST})")
        axes.axvline(1, color="0.4", lw=1, zorder=0.5)


def _label(what: str) -> str:
    """A claim's words in two lines."""
    lines = textwrap.wrap(what, WORDS)
    return "\n".join([lines[0], textwrap.shorten(" ".join(lines[1:]), WORDS, placeholder=" ...")][: len(lines)])


def _claim(axes: Axes, row: Mapping[str, Any], y: Number) -> None:
    """Draws the diamonds, dots, intervals and figures of one claim."""
    mark, papers, ours = MARKS[row["verdict"]], _components(row["paper"]), _components(row["ours"])
    if len(papers) < len(ours):  # several cases of ours beside one number of the paper
        papers = papers * len(ours)
    lows, highs = _components(row["low"]), _components(row["high"])
    for i, paper in enumerate(papers):
        at = y + (i / (len(papers) - 1) - 0.5) * SPREAD if 1 < len(papers) <= FEW else y
        axes.plot(_place(paper, paper, row), at, marker="D", color="black", mfc="white", ms=7, ls="", zorder=2)
        if ours:
            interval = [_place(end[i], paper, row) for end in (lows, highs) if end and len(ours) <= FEW]
            axes.plot(interval, [at] * len(interval), color=mark.colour, lw=2, zorder=1)
            _dot(axes, _place(ours[i], paper, row), at, mark)
    _figures(axes, row, y, mark)


def _figures(axes: Axes, row: Mapping[str, Any], y: Number, mark: Mark) -> None:
    """The sign of the verdict, and both values, to the right of a row."""
    values = [_short(row[side]) for side in ("paper", "ours") if row[side] is not None]
    text = (" → " if len("".join(values)) < 22 else " →\n").join(values)
    side = {"transform": axes.get_yaxis_transform(), "va": "center"}
    axes.text(1.015, y, mark.sign, color=mark.colour, fontweight="bold", fontsize=12, **side)
    colour = "0.5" if row["verdict"] == NOT_RUN else "black"
    axes.text(1.06, y, text, color=colour, fontsize=9.5, **side)


def _short(value: Any) -> str:
    """A value for readers; of many components the least and the largest."""
    each = _components(value)
    return printed(value) if len(each) <= FEW else f"{printed(min(each))} to {printed(max(each))}"


def _dot(axes: Axes, x: Number, y: Number, mark: Mark) -> None:
    beyond = x >= WIDEST
    axes.plot(x, y, marker=">" if beyond else mark.marker, color=mark.colour, mec="white", mew=0.5, ms=9, zorder=3)


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


def _legend(figure: Figure, rows: pd.DataFrame) -> None:
    """Explains the marks that occur, above the panels."""
    kinds = [kind for kind in MARKS if (rows.verdict == kind).any() and kind != NOT_RUN]
    handles = [
        Line2D([], [], marker=MARKS[kind].marker, color=MARKS[kind].colour, lw=2, ms=9, label=told(kind))
        for kind in kinds
    ]
    figure.legend(handles=[PAPER, *handles], loc="outside upper center", ncols=4, frameon=False, fontsize=11)
