"""What is predicted for the experiments beyond the paper, written down before they ran (params/predictions.yaml)."""

import json
import math
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from pydantic import Field

from lt_lib.report.claims import JUDGED
from lt_lib.report.entries import parsed, read_entries
from lt_lib.report.registration import Registered, register_each
from lt_lib.settings.base import ROOT, Settings, UserError
from lt_lib.store.files import write_checked

PREDICTIONS = ROOT / "params" / "predictions.yaml"
HELD, NOT_HELD, NO_VERDICT = "held", "did not hold", ""


class Prediction(Settings):
    """One entry of predictions.yaml; the head of that file explains every field."""

    id: str
    nb: str
    hypothesis: str
    measure: str
    test: str
    margin: float


class Outcome(Settings):
    """What came of a prediction: the measure, its test's p where it has one, and whether the prediction holds."""

    value: float
    p: Annotated[float, Field(ge=0, le=1)] | None = None
    holds: bool
    note: str = ""


class Predictions:
    """Collects the outcomes of one notebook's predictions and writes them to <outputs>/results/<notebook>.json.

    notebook, outputs, profile  as in `report.claims.Findings`; only the full profile gives verdicts
    """

    def __init__(self, notebook: str, outputs: Path, profile: str, path: Path = PREDICTIONS):
        self.notebook, self.profile = notebook, profile
        self.path = Path(outputs) / "results" / f"{notebook}.json"
        entries = read_entries(path, Prediction, "id")
        self.predicted = {name: entry for name, entry in entries.items() if entry.nb == notebook}
        self.found: dict[str, Outcome] = {}

    def margin(self, name: str) -> float:
        """The margin that was written down for a prediction."""
        return self.predicted[name].margin

    def add(self, name: str, value: float, holds: bool, p: float | None = None, note: str = "") -> None:
        """Adds what came of a prediction.

        Raises a one-line UserError for an id that is none of the notebook's or was already added, and for a value that
        is not finite.
        """
        where = f"{self.notebook}: {name}"
        if name not in self.predicted or name in self.found:
            reason = "was already added" if name in self.found else "is not one of its predictions"
            raise UserError(f"{where} {reason}")
        if not math.isfinite(value):
            raise UserError(f"{where}: value must be finite, got {value}")
        entry: dict[str, Any] = {"value": float(value), "holds": bool(holds), "note": note}
        self.found[name] = parsed(Outcome, entry | ({} if p is None else {"p": float(p)}), where)

    def verdict(self, name: str) -> str:
        if self.profile != JUDGED:
            return NO_VERDICT
        return HELD if self.found[name].holds else NOT_HELD

    def write(self) -> Path:
        """Writes the results file; returns its path. Raises a one-line UserError if a prediction has no outcome."""
        missing = [name for name in self.predicted if name not in self.found]
        if missing:
            raise UserError(f"{self.notebook}: nothing found for {', '.join(missing)}")
        outcomes = {name: self.found[name].model_dump() | {"verdict": self.verdict(name)} for name in self.predicted}
        content = {"notebook": self.notebook, "profile": self.profile, "predictions": outcomes}
        write_checked(self.path, content)
        return self.path

    def table(self) -> pd.DataFrame:
        """Every prediction beside what came of it."""
        rows = [
            [
                entry.hypothesis,
                entry.measure,
                f"{self.found[name].value:.3f}",
                f"{entry.margin:g}",
                "" if self.found[name].p is None else f"{self.found[name].p:.2g}",
                self.verdict(name),
            ]
            for name, entry in self.predicted.items()
        ]
        columns = ["hypothesis", "measure", "value", "margin", "p", "verdict"]
        return pd.DataFrame(rows, index=pd.Index(self.predicted, name="prediction"), columns=columns)


def registered(notebook: str, outputs: Path) -> Registered:
    """Each of a notebook's entries in predictions.yaml at its first use in an outputs folder, and now."""
    entries = {
        name: json.dumps(entry.model_dump(), sort_keys=True).encode()
        for name, entry in read_entries(PREDICTIONS, Prediction, "id").items()
        if entry.nb == notebook
    }
    return register_each("predictions", entries, Path(outputs) / f"registered_{notebook}.json")
