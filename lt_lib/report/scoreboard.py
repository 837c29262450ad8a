"""The scoreboard: every claim of the paper beside what the notebooks found, as a table and as Markdown."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pandas.io.formats.style import Styler
from pydantic import ValidationError

from lt_lib.report.claims import (
    CALIBRATED,
    CONTEXT,
    GATE,
    JUDGED,
    NEEDS_A_ROBOT,
    NO_VERDICT,
    NOT_REPRODUCED,
    NOT_RUN,
    REPRODUCED,
    SAME_DIRECTION,
    Claim,
    Finding,
    Findings,
    Notebook,
    verdict,
)
from lt_lib.report.firmness import FRAGILE
from lt_lib.settings.base import Settings, UserError
from lt_lib.settings.profiles import explain
from lt_lib.store.files import content_digest, writable_folder, write_atomically

TESTED_VERDICTS = (REPRODUCED, SAME_DIRECTION, NOT_REPRODUCED)
DISCUSSED = "discussed in"  # the notebook that says what was tried and what the likeliest cause is
COLUMNS = [
    "id", "notebook", "what", "kind", "paper", "ours", "low", "high", "n", "test", "p", "verdict", "firm", "follows",
    "note",
]  # fmt: skip
SETTINGS = ("exact", "config")  # kinds that are settings and arithmetic, not outcomes


class Mark(NamedTuple):
    """How a verdict looks. Colours are Okabe and Ito's; shape and sign identify it without colour."""

    colour: str
    marker: str
    sign: str


MARKS = {
    REPRODUCED: Mark("#0072B2", "o", "✔"),
    SAME_DIRECTION: Mark("#E69F00", "^", "≈"),
    NOT_REPRODUCED: Mark("#D55E00", "X", "✘"),
    CALIBRATED: Mark("#56B4E9", "v", "≙"),
    GATE: Mark("#009E73", "D", "▣"),
    CONTEXT: Mark("#999933", "P", "○"),
    NEEDS_A_ROBOT: Mark("#CC79A7", "s", "◌"),
    NO_VERDICT: Mark("#555555", "o", "?"),
    NOT_RUN: Mark("#999999", "", "·"),
}
LEGEND = """\
Verdicts: ✔ **reproduced** - the number lies within its margin (`params/claims.yaml`) and the row's own test, which
could have failed, holds; settings are equal, exact numbers print alike; ≈ **same direction** - the test of the
paper's statement holds, but the number lies outside its margin; ✘ **not reproduced** - the test fails; ≙
**calibrated** - a setting that the paper does not print was inferred from this row, so it counts for nothing; ▣
**gate** - the run stops where this threshold is missed, so the row cannot fail; ○ **context** - geometry or
settings that the paper does not print, or a finding of ours that it does not have; ◌ **needs a robot** - made with
a simulated camera; · **not run** - no finding.

*Firm* is the share of resamples of a row's seeds and episodes that give the same verdict; below 0.8 it is
*fragile*. A row that *follows* another restates it and is not counted again. The rules of all tests stand in
`lt_lib/report/stats.py`; what would refute a row stands in `params/claims.yaml`, and the tests feed every judge
with such a result."""


class _Entry(Finding):
    """A finding as stored in its file. The verdict there is for readers; the scoreboard judges anew."""

    verdict: str


class _Results(Settings):
    """The results file that a notebook writes at its end."""

    notebook: str
    profile: str
    pending: tuple[str, ...]
    findings: dict[str, _Entry]


def read_findings(outputs: Path, claims: Mapping[str, Claim], profile: str) -> dict[str, Finding]:
    """The findings of every results file under an output folder, by claim id.

    Raises a one-line UserError with file and id for a file that cannot be read or comes from another notebook or
    profile, an id in two files, an id that is unknown or belongs to another notebook, and a notebook that lacks one of
    its ids without listing it as pending.
    """
    paths = (Path(outputs) / "results" / f"{name}.json" for name in Notebook.__args__)  # none beyond the paper
    files = [_read_results(path, profile) for path in paths if path.exists()]
    owners: dict[str, str] = {}
    for results in files:
        for name in results.findings:
            if name in owners:
                raise UserError(f"{name} is in two files: {owners[name]}.json and {results.notebook}.json")
            owners[name] = results.notebook
    for name, notebook in owners.items():
        if name not in claims:
            raise UserError(f"{notebook}.json: {name} is not in claims.yaml")
        if claims[name].nb != notebook:
            raise UserError(f"{notebook}.json: {name} belongs to {claims[name].nb}")
    for results in files:
        known = {*results.findings, *results.pending}
        lacking = [name for name, claim in claims.items() if claim.nb == results.notebook and name not in known]
        if lacking:
            raise UserError(f"{results.notebook}.json: no finding for {', '.join(lacking)}, and not listed as pending")
    return {name: finding for results in files for name, finding in results.findings.items()}


def _read_results(path: Path, profile: str) -> _Results:
    """Reads one results file and checks it by itself."""
    try:
        content = dict(json.loads(path.read_bytes()))
        expected = content.pop("sha256", None)  # older files have none
        if expected not in (None, content_digest(content)):
            raise UserError(f"{path.name}: was altered (its checksum differs); run its notebook again")
        results = _Results(**content)
    except ValidationError as error:
        raise UserError(explain(error, path.name, _Results)) from None
    except (OSError, ValueError, TypeError) as error:
        raise UserError(f"{path.name}: not a results file: {error}") from None
    if results.notebook != path.stem:
        raise UserError(f"{path.name}: was written by {results.notebook}")
    if results.profile != profile:
        raise UserError(f"{path.name}: made with profile {results.profile}, but this scoreboard is for {profile}")
    return results


def join(claims: Mapping[str, Claim], findings: Mapping[str, Finding], profile: str) -> pd.DataFrame:
    """The board: one row per claim in the order of claims.yaml, with exactly the columns COLUMNS; lists stay lists."""
    rows = [_row(claim, findings.get(name), profile) for name, claim in claims.items()]
    return pd.DataFrame(rows, columns=COLUMNS, dtype=object)


def _row(claim: Claim, finding: Finding | None, profile: str) -> dict[str, Any]:
    found = {name: None for name in ("value", "low", "high", "n", "test", "p")}
    if finding is not None:
        found = {name: _as_list(getattr(finding, name)) for name in found}
    return {
        "id": claim.id,
        "notebook": claim.nb,
        "what": claim.what,
        "kind": claim.kind,
        "paper": _as_list(claim.paper),
        "ours": found.pop("value"),
        **found,
        "verdict": verdict(claim, finding, profile),
        "firm": finding.firm if finding else None,
        "follows": claim.follows,
        "note": finding.note if finding else "",
    }


def _as_list(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def deviations(board: pd.DataFrame) -> pd.DataFrame:
    """The rows that depart from the paper, not reproduced first, with the notebook that discusses each."""
    parts = [board[(board.verdict == kind) & (board.follows == "")] for kind in (NOT_REPRODUCED, SAME_DIRECTION)]
    return pd.concat(parts).rename(columns={"notebook": DISCUSSED})


def independent(board: pd.DataFrame) -> pd.DataFrame:
    """The measured facts, each once: no settings, no context, no gates, no calibrating row, and none that follows."""
    apart, uncounted = (*SETTINGS, "scene", "ours"), (GATE, NEEDS_A_ROBOT, CALIBRATED)
    return board[~board.kind.isin(apart) & (board.follows == "") & ~board.verdict.isin(uncounted)]


def summary(board: pd.DataFrame) -> str:
    """The verdicts in two sentences: each measured fact once, then whatever is counted apart."""
    facts = independent(board)
    counts, names = facts.verdict.value_counts(), {NO_VERDICT: "without a verdict"}
    parts = [f"{counts[kind]} {names.get(kind, kind)}" for kind in MARKS if kind in counts]
    fragile = int((facts.firm.dropna().astype(float) < FRAGILE).sum())
    settings = board[board.kind.isin(SETTINGS) & ~board.verdict.isin((GATE,))]
    agree = int((settings.verdict == REPRODUCED).sum())
    apart = {
        "settings and exact numbers": f"{agree} of {len(settings)}",
        "rows that follow from another": (board.follows != "").sum(),
        "calibrated": (board.verdict == CALIBRATED).sum(),
        "gates": (board.verdict == GATE).sum(),
        "context": board.kind.isin(("scene", "ours")).sum(),
        "needs a robot": (board.verdict == NEEDS_A_ROBOT).sum(),
    }
    rest = ", ".join(f"{words} {count}" for words, count in apart.items() if count)
    return (
        f"Of {len(facts)} independent measured claims: {', '.join(parts)} ({fragile} fragile). Counted apart: {rest}."
    )


def stamp(board: pd.DataFrame, profile: str) -> str:
    """The stamp on every table and figure below the paper's scale; '' for the full profile."""
    sizes = [int(n) for n in board.n.dropna()]
    n = f"n = {min(sizes)} to {max(sizes)}" if sizes else "no findings"
    if profile == JUDGED:
        return ""
    return f"{profile.upper()}: not a result (profile {profile}, {n})"


def headline(board: pd.DataFrame) -> str:
    """Markdown table of route optimality by message content (Table III), for the README."""
    rows = board[board.id.str.fullmatch(r"px\.\w+\.route")]
    rows = rows.assign(message=rows.what.str.removeprefix("route optimality - "))
    return _table(rows, ["message", "n", "paper", "ours", "p", "verdict"])


def markdown(board: pd.DataFrame, profile: str) -> str:
    """The whole board as Markdown: summary, stamp, legend, deviations, one table per notebook."""
    mark = stamp(board, profile)
    parts = ["# Scoreboard", f"**{summary(board)}**", *([f"**{mark}**"] if mark else []), LEGEND]
    unlike = deviations(board)
    if len(unlike):
        columns = ["id", "what", "paper", "ours", "test", "p", "verdict", "firm", "note", DISCUSSED]
        parts += ["## Not as in the paper", _table(unlike, columns)]
    for notebook, rows in board.groupby("notebook"):
        columns = [name for name in COLUMNS if name not in ("notebook", "low", "high")]
        parts += [f"## {notebook}", *([mark] if mark else []), _table(rows, columns)]
    return "\n\n".join(parts) + "\n"


def _table(rows: pd.DataFrame, columns: Sequence[str]) -> str:
    """A Markdown table; `ours` carries its interval and the verdict its sign."""
    lines = [columns, ["---"] * len(columns)]
    lines += [[_cell(row, column) for column in columns] for row in rows.to_dict("records")]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(row: Mapping[str, Any], column: str) -> str:
    if column == DISCUSSED:
        return f"[{row[column]}](notebooks/{row[column]}.ipynb)"
    if column == "verdict":
        return told(row["verdict"], row["firm"])
    text = estimated(row["ours"], row["low"], row["high"]) if column == "ours" else printed(row[column], column)
    return text.replace("|", "\\|").replace("\n", " ")


def told(kind: str, firm: float | None = None) -> str:
    """A verdict with its sign, marked where it is fragile; without a verdict, the word that says why."""
    fragile = " (fragile)" if firm is not None and firm < FRAGILE and kind in TESTED_VERDICTS else ""
    return f"{MARKS[kind].sign} {kind or 'no verdict'}{fragile}"


def estimated(value: Any, low: Any, high: Any) -> str:
    """A value with its interval, component by component: '0.785 [0.731, 0.831], 0.859 [0.812, 0.897]'."""
    if low is None:
        return printed(value)
    values, lows, highs = ((x if isinstance(x, (list, tuple)) else [x]) for x in (value, low, high))
    parts = zip(values, lows, highs, strict=True)
    return ", ".join(f"{printed(v)} [{printed(a)}, {printed(b)}]" for v, a, b in parts)


def printed(value: Any, column: str = "") -> str:
    """A value for readers: three decimals, p with two significant digits, nothing for None."""
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    if isinstance(value, (list, tuple)):
        return ", ".join(map(printed, value))
    if isinstance(value, str):
        return value
    if column == "p" or (isinstance(value, float) and 0 < abs(value) < 0.001):
        return f"{value:.2g}"
    if isinstance(value, float) and abs(value) < 1000:
        return f"{value:.2f}" if column == "firm" else f"{value:.3f}"
    return f"{value:,.0f}"


def styled(rows: pd.DataFrame, board: pd.DataFrame, profile: str) -> Styler:
    """Some rows of a board for display in a notebook, with coloured verdicts under the board's stamp."""
    # a coloured edge and not coloured letters, which would be hard to read on white or on black
    colours = {kind: f"border-left: 5px solid {mark.colour}; font-weight: bold" for kind, mark in MARKS.items()}
    columns = ["id", "what", "paper", "ours", "n", "test", "p", "verdict", "note"]
    shown = [{name: _cell(row, name) for name in columns} for row in rows.to_dict("records")]
    cells = pd.DataFrame(shown, columns=columns)
    return (
        cells.style.apply(lambda _: [colours[kind] for kind in rows.verdict], subset=["verdict"])
        .hide(axis="index")
        .set_caption(stamp(board, profile))
        .set_properties(**{"text-align": "left"})
    )


def own(findings: Findings) -> Styler:
    """One notebook's rows of the scoreboard, for display at its end."""
    board = join(findings.claims, findings.found, findings.profile)
    return styled(board[board.id.isin(findings.found)], board, findings.profile)


def write(board: pd.DataFrame, outputs: Path, profile: str) -> None:
    """Writes scoreboard.csv, scoreboard.md and headline.md; raises UserError if they cannot be written."""
    writable_folder(Path(outputs))
    summed = f"{headline(board)}\n\n{summary(board)}\n"
    write_atomically(Path(outputs) / "headline.md", summed.encode())
    write_atomically(Path(outputs) / "scoreboard.csv", board.to_csv(index=False).encode())
    write_atomically(Path(outputs) / "scoreboard.md", markdown(board, profile).encode())
