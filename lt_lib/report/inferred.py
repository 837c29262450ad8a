"""Settings that the paper does not print, inferred from rows set aside for it (params/inferred.yaml)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from lt_lib.report.entries import read_entries
from lt_lib.report.registration import Registration, register
from lt_lib.settings.base import ROOT, Settings

INFERRED = ROOT / "params" / "inferred.yaml"
RECORD = "inferred.json"


class Inferred(Settings):
    """One entry of inferred.yaml; the head of that file explains every field."""

    setting: str
    what: str
    tried: Annotated[tuple[Any, ...], Field(min_length=2)] | dict[str, list[Any]]
    calibrates: tuple[str, ...]
    measure: str
    target: Annotated[tuple[float, ...], Field(min_length=1)]
    rule: Literal["nearest", "largest"]
    predicts: Annotated[tuple[str, ...], Field(min_length=1)]

    def __str__(self) -> str:
        rows = f"calibrated on {', '.join(self.calibrates)}" if self.calibrates else "calibrated on no row of the paper"
        return (
            f"{self.setting}: {self.what}\n  measure: {self.measure}\n  rule: {self.rule} {self.target}, {rows}\n"
            f"  predicts: {', '.join(self.predicts)}"
        )

    def choose(self, measured: Mapping[Any, float | Sequence[float]]) -> Any:
        """The value that the rule picks from what was measured for each value tried; the first of equals.

        Raises ValueError for a measure of another shape than the target.
        """
        values = list(measured)
        numbers = np.array([np.atleast_1d(measured[value]) for value in values], float)  # (values, targets)
        if numbers.shape[1:] != (len(self.target),):
            raise ValueError(f"{self.setting}: expected {len(self.target)} numbers per value, got {numbers.shape[1:]}")
        if self.rule == "largest":
            return values[int(numbers.sum(axis=1).argmax())]
        return values[int(np.abs(numbers - self.target).sum(axis=1).argmin())]


class Choice(NamedTuple):
    """What the rule picks, beside the value in use."""

    picked: Any
    used: Any

    def __str__(self) -> str:
        if self.picked == self.used:
            return f"the rule picks {self.picked}, the value in use"
        return f"here the rule picks {self.picked}; {self.used} is in use"


def load_inferred(path: Path = INFERRED) -> dict[str, Inferred]:
    """Every inferred setting by where its value stands. Raises a one-line UserError for an unreadable file or entry."""
    return read_entries(path, Inferred, "setting")


def calibrating_rows(path: Path = INFERRED) -> dict[str, str]:
    """The setting that each calibrating row gave, by the row's id."""
    return {row: name for name, setting in load_inferred(path).items() for row in setting.calibrates}


def registered(outputs: Path) -> Registration:
    """The checksum of inferred.yaml at its first use in an outputs folder, and now."""
    return register("inferred settings", INFERRED.read_bytes(), Path(outputs) / RECORD)
