"""Pages for readers whose numbers come from an outputs folder: templates with `{{claim}}` in the text.

`{{px.latent.route:.3f}}` is what was found for a claim or a prediction, in Python's format; `{{cov.boost_early[0]}}`
is the first of several; `{{paper px.latent.route:.3f}}` is what the paper prints. A line of a list or table whose
numbers were not computed, as those beyond the paper after a run of the paper alone, is left out.
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from lt_lib.report.claims import load_claims
from lt_lib.report.scoreboard import MARKS
from lt_lib.settings.base import UserError

TEMPLATES = Path(__file__).parent / "templates"
NUMBER = re.compile(r"\{\{(?P<paper>paper )?(?P<id>[\w.]+?)(?:\[(?P<item>\d)\])?(?::(?P<format>[^}]+))?\}\}")
SHOWN = ("latent", "predicted", "oracle", "raw", "floor", "zerowire", "position", "trajectory")  # of Table III


def found_in(outputs: Path) -> dict[str, Any]:
    """What the notebooks found, by claim and by prediction."""
    values: dict[str, Any] = {}
    for path in sorted((outputs / "results").glob("*.json")):
        results = json.loads(path.read_text(encoding="utf-8"))
        entries = results.get("findings") or results.get("predictions") or {}
        values |= {name: entry["value"] for name, entry in entries.items()}
    return values


def filled(template: str, values: Mapping[str, Any], paper: Mapping[str, Any], missing: str | None = None) -> str:
    """A template with its numbers; lines of lists and tables that lack one are left out.

    missing  what stands for a number that was not computed

    Raises UserError for any other line that lacks one, if nothing may stand for it.
    """

    def told(found: re.Match) -> str:
        known = paper if found["paper"] else values
        return missing if missing and known.get(found["id"]) is None else _told(found, known)

    lines = []
    for line in template.splitlines():
        try:
            lines.append(NUMBER.sub(told, line))
        except KeyError as lacking:
            if not line.startswith(("- ", "| ")):
                raise UserError(f"template: nothing was found for {lacking}, in '{line[:60]}'") from None
    return "\n".join(lines)


def _told(found: re.Match, values: Mapping[str, Any]) -> str:
    value = values[found["id"]]
    if found["item"]:
        value = value[int(found["item"])]
    return format(value, found["format"] or "")


def page(name: str, outputs: Path) -> str:
    """A template, filled for an outputs folder."""
    return filled((TEMPLATES / f"{name}.md").read_text(encoding="utf-8"), found_in(outputs), in_the_paper())


def in_the_paper() -> dict[str, Any]:
    """What the paper prints, by claim."""
    return {claim: entry.paper for claim, entry in load_claims().items()}


def table_three(outputs: Path) -> str:
    """Table III's rows without a redrawn route, as Markdown: the paper's mean, ours with its interval, the verdict."""
    board = pd.read_csv(outputs / "scoreboard.csv", keep_default_na=False).set_index("id")
    lines = ["| message | paper | here [95% interval] | verdict |", "| --- | --- | --- | --- |"]
    for name in SHOWN:
        row = board.loc[f"px.{name}.route"]
        ours = f"{float(row.ours):.3f}" + (f" [{float(row.low):.3f}, {float(row.high):.3f}]" if row.low != "" else "")
        words = row.what.removeprefix("route optimality - ")
        lines.append(f"| {words} | {float(row.paper):.3f} | {ours} | {MARKS[row.verdict].sign} {row.verdict} |")
    return "\n".join(lines)
