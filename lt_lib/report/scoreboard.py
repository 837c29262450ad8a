"""The scoreboard: every claim of the paper beside what the notebooks found, as a table and as Markdown."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from pandas.io.formats.style import Styler
from pydantic import ValidationError

from lt_lib.report.claims import (
    JUDGED,
    NO_VERDICT,
    NOT_REPRODUCED,
    NOT_RUN,
    REPRODUCED,
    SAME_DIRECTION,
    SURROGATE,
    Claim,
    Finding,
    Findings,
    verdict,
)
from lt_lib.settings.base import Settings, UserError
from lt_lib.settings.profiles import explain
from lt_lib.store.files import content_digest, writable_folder, write_atomically

DISCUSSED = "discussed in"  # the notebook that says what was tried and what the likeliest cause is
COLUMNS = ["id", "notebook", "what", "kind", "paper", "ours", "low", "high", "n", "test", "p", "verdict"]


class Mark(NamedTuple):
    """How a verdict looks. Colours are Okabe and Ito's; shape and sign identify it without colour."""

    colour: str
    marker: str
    sign: str


MARKS = {
    REPRODUCED: Mark("#0072B2", "o", "✔"),
    SAME_DIRECTION: Mark("#E69F00", "^", "≈"),
    NOT_REPRODUCED: Mark("#D55E00", "X", "✘"),
    SURROGATE: Mark("#CC79A7", "s", "◌"),
    NO_VERDICT: Mark("#555555", "o", "?"),
    NOT_RUN: Mark("#999999", "", "·"),
}
LEGEND = """\
Verdicts: ✔ **reproduced** - exact numbers print alike, settings are equal, measured values lie within the
margin that `params/claims.yaml` fixed beforehand (or meet the check stated there), and the claim's own test
holds; ≈ **same direction** - the test holds, but the value lies outside the margin; ✘ **not reproduced** - the
test fails, or there is no test and the value lies outside the margin; ◌ **surrogate** - made with a simulated
camera where the paper used the robot's; · **not run** - no finding. A rank test holds if no seed overlaps the
seeds it is compared with. A scene number whose check is 'reported' depends on geometry that the paper does not
print, so it only has to stand beside the paper's."""


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
    files = [_read_results(path, profile) for path in sorted((Path(outputs) / "results").glob("*.json"))]
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
    }


def _as_list(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def deviations(board: pd.DataFrame, findings: Mapping[str, Finding]) -> pd.DataFrame:
    """The rows that depart from the paper, not reproduced first, with notes and the notebook that discusses each."""
    rows = [board[board.verdict == kind] for kind in (NOT_REPRODUCED, SAME_DIRECTION)]
    part = pd.concat(rows)[["id", "what", "paper", "ours", "low", "high", "test", "p", "verdict", "notebook"]]
    notes = [findings[name].note for name in part.id]
    return part.rename(columns={"notebook": DISCUSSED}).assign(note=notes)


def summary(board: pd.DataFrame) -> str:
    """The verdicts in one line, e.g. '61 reproduced, 3 same direction, 2 not reproduced, 80 not run, of 146'."""
    counts = board.verdict.value_counts()
    names = {NO_VERDICT: "without a verdict"}
    parts = [f"{counts[kind]} {names.get(kind, kind)}" for kind in MARKS if kind in counts]
    return f"{', '.join(parts)}, of {len(board)}"


def stamp(board: pd.DataFrame, profile: str) -> str:
    """The stamp on every table and figure below the paper's scale; '' for the full profile."""
    sizes = [int(n) for n in board.n.dropna()]
    n = f"n = {min(sizes)} to {max(sizes)}" if sizes else "no findings"
    if profile == "full":
        return ""
    return f"profile {profile}, {n}" if profile in JUDGED else f"SMOKE: not a result (profile {profile}, {n})"


def headline(board: pd.DataFrame) -> str:
    """Markdown table of route optimality by message content (Table III), for the README."""
    rows = board[board.id.str.fullmatch(r"px\.\w+\.route")]
    rows = rows.assign(message=rows.what.str.removeprefix("route optimality - "))
    return _table(rows, ["message", "n", "paper", "ours", "p", "verdict"])


def markdown(board: pd.DataFrame, findings: Mapping[str, Finding], profile: str) -> str:
    """The whole board as Markdown: summary, stamp, legend, deviations with notes, one table per notebook."""
    mark = stamp(board, profile)
    parts = ["# Scoreboard", f"**{summary(board)}**", *([f"**{mark}**"] if mark else []), LEGEND]
    unlike = deviations(board, findings)
    if len(unlike):
        columns = ["id", "what", "paper", "ours", "test", "p", "verdict", "note", DISCUSSED]
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
    if column == "verdict":
        return told(row["verdict"])
    text = shown(row[column])
    if column == DISCUSSED:
        return f"[{text}](notebooks/{text}.ipynb)"
    if column == "ours" and row["low"] is not None:
        text += f" [{shown(row['low'])}, {shown(row['high'])}]"
    return text.replace("|", "\\|").replace("\n", " ")


def told(kind: str) -> str:
    """A verdict with its sign; without a verdict, the word that says why."""
    return f"{MARKS[kind].sign} {kind or 'smoke'}"


def shown(value: Any) -> str:
    """A value for readers: four significant digits, lists component by component, nothing for None."""
    if value is None:
        return ""
    if isinstance(value, (list, tuple)):
        return ", ".join(map(shown, value))
    if isinstance(value, float) and abs(value) < 1000:
        return f"{value:.4g}"
    return value if isinstance(value, str) else f"{value:,.0f}"


def styled(rows: pd.DataFrame, board: pd.DataFrame, profile: str) -> Styler:
    """Some rows of a board for display in a notebook, with coloured verdicts under the board's stamp."""
    colours = {kind: f"color: {mark.colour}; font-weight: bold" for kind, mark in MARKS.items()}
    rows = rows.drop(columns="notebook", errors="ignore")
    return (
        rows.style.format(shown, subset=rows.columns.drop("verdict"))
        .format(told, subset=["verdict"])
        .map(colours.get, subset=["verdict"])
        .hide(axis="index")
        .set_caption(stamp(board, profile))
        .set_properties(**{"text-align": "left"})
    )


def own(findings: Findings) -> Styler:
    """One notebook's rows of the scoreboard, for display at its end."""
    board = join(findings.claims, findings.found, findings.profile)
    return styled(board[board.id.isin(findings.found)], board, findings.profile)


def write(board: pd.DataFrame, findings: Mapping[str, Finding], outputs: Path, profile: str) -> None:
    """Writes scoreboard.csv and scoreboard.md, each whole or not at all; raises UserError if they cannot be written."""
    writable_folder(Path(outputs))
    write_atomically(Path(outputs) / "scoreboard.csv", board.to_csv(index=False).encode())
    write_atomically(Path(outputs) / "scoreboard.md", markdown(board, findings, profile).encode())
