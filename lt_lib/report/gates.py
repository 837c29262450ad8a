"""The table of the freeze gates, for any encoder."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

WORDS = {
    "hazard": "hazard-visible probe",
    "majority": "majority baseline",
    "walls": "wall-count R²",
    "appearance": "R² of floor and wall colours",
    "share": "hazard's share of variance",
    "rank": "effective rank",
    "rank_eigen": "(by eigenvalues)",
}


def table(reports: Mapping[str, Mapping[str, Any]], thresholds: Mapping[str, float]) -> pd.DataFrame:
    """One row per gate and one column per encoder, with the preregistered thresholds in the last column."""
    rows = dict(reports) | {"must reach": thresholds}
    columns = {name: {words: each.get(key) for key, words in WORDS.items()} for name, each in rows.items()}
    return pd.DataFrame(columns, dtype=float).dropna(how="all").round(3)
