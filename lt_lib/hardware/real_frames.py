"""Frames of a real camera (Section Hardware): a folder of pictures with their labels, checked row by row.

    labels.csv   file,session,placement,distance_cm,lighting,hazard     one row per decision
    optics.yaml  crop: 210       side in pixels of the central square that subtends 32 degrees, by tape
    *.png *.jpg  all of one size

`session` is refit, validation or live, `placement` a whole number, `lighting` bright or dim, `hazard` 1 or 0.
"""

import csv
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from lt_lib.hardware.optics import CROP, crop
from lt_lib.hardware.sessions import Session
from lt_lib.settings.base import UserError, require_known

LABELS, OPTICS = "labels.csv", "optics.yaml"
COLUMNS = ("file", "session", "placement", "distance_cm", "lighting", "hazard")
SESSIONS = ("refit", "validation", "live")
WORDS = {"session": SESSIONS, "lighting": ("bright", "dim"), "hazard": ("0", "1")}
SUFFIXES = (".png", ".jpg", ".jpeg")
SAME = 2.0  # grey levels: crops whose mean difference is less are one frame, saved twice


def read_sessions(folder: Path) -> dict[str, Session]:
    """The three sessions of a folder of real frames, cropped by its stated optics.

    Raises UserError, one line with the file and the row, for anything that is missing, unknown, of a wrong size, no
    image, truncated, or a frame that is in two sessions.
    """
    side, rows = read_crop(folder), read_rows(folder)
    frames, size = [], None
    for number, row in rows:
        picture = _read_picture(folder / row["file"], f"{LABELS} row {number}: {row['file']}")
        size = size or picture.shape[:2]
        _check_size(picture, size, side, f"{folder / LABELS} row {number}: {row['file']}")
        frames.append(crop(picture, side))
    _check_leaks(folder, rows, frames)
    return {name: _session(name, rows, frames, folder) for name in SESSIONS}


def read_crop(folder: Path) -> int:
    """The stated side of the 32 degrees, pixels. Raises UserError for a folder that does not state it."""
    path = folder / OPTICS
    if not path.is_file():
        raise UserError(f"{path} is missing; it states 'crop: <side in pixels that subtends 32 degrees>' (HARDWARE.md)")
    try:
        stated = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError):
        stated = None
    side = stated.get("crop") if isinstance(stated, dict) and set(stated) == {"crop"} else None
    if type(side) is not int or side < CROP:
        raise UserError(f"{path}: expected one line 'crop: <whole number of pixels, at least {CROP}>', got {stated!r}")
    return side


def read_rows(folder: Path) -> list[tuple[int, dict[str, str]]]:
    """(row number as a spreadsheet shows it, row) of every label. Raises UserError for an invalid row."""
    path = folder / LABELS
    if not path.is_file():
        raise UserError(f"{path} is missing; it has the columns {','.join(COLUMNS)}")
    with path.open(newline="", encoding="utf-8-sig") as file:
        table = csv.DictReader(file)
        if tuple(table.fieldnames or ()) != COLUMNS:
            raise UserError(f"{path} row 1: expected the columns {','.join(COLUMNS)}, got {table.fieldnames}")
        rows = list(enumerate(table, start=2))
    if not rows:
        raise UserError(f"{path} has no rows")
    seen: dict[str, int] = {}
    for number, row in rows:
        _check_row(row, folder, f"{path} row {number}")
        first = seen.setdefault(row["file"], number)
        if first != number:
            raise UserError(f"{path} row {number}: {row['file']} is there twice, first in row {first}")
    return rows


def _check_row(row: Mapping[str, str], folder: Path, where: str) -> None:
    if None in row or None in row.values():
        raise UserError(f"{where}: expected {len(COLUMNS)} values")
    for column, words in WORDS.items():
        require_known([row[column]], words, column, f"{where}: ")
    for column, kind, what in (("placement", int, "a whole number"), ("distance_cm", float, "a distance in cm")):
        if not _is_positive(row[column], kind):
            raise UserError(f"{where}: {column} must be {what}, at least 0, got '{row[column]}'")
    if not row["file"].lower().endswith(SUFFIXES):
        raise UserError(f"{where}: '{row['file']}' is neither PNG nor JPEG ({', '.join(SUFFIXES)})")
    if not (folder / row["file"]).is_file():
        raise UserError(f"{where}: {row['file']} is missing")


def _is_positive(text: str, kind: Callable) -> bool:
    try:
        return 0 <= kind(text) < np.inf
    except ValueError:
        return False


def _read_picture(path: Path, where: str) -> UInt8[np.ndarray, "h w 3"]:
    """RGB. Raises UserError for what is no image, and for an image whose end is missing."""
    try:
        with Image.open(path) as image:
            image.load()
            return np.asarray(image.convert("RGB"))
    except UnidentifiedImageError:
        raise UserError(f"{where} is no image") from None
    except (OSError, SyntaxError, ValueError) as error:  # Pillow's words for a file that ends too early
        raise UserError(f"{where} is truncated or damaged ({error})") from None


def _check_size(picture, size: tuple[int, int], side: int, where: str) -> None:
    height, width = picture.shape[:2]
    if (height, width) != size:
        raise UserError(f"{where} is {width} x {height} pixels, the first is {size[1]} x {size[0]}; use one size")
    if min(height, width) < side:
        raise UserError(f"{where} is {width} x {height} pixels, smaller than the crop of {side} x {side}")


def _check_leaks(folder: Path, rows, frames) -> None:
    """No frame in two sessions, not even saved anew: what a probe is fitted on must not come back as a test."""
    crops = np.array(frames, np.int16)
    sessions = np.array([row["session"] for _, row in rows])
    for i in range(1, len(rows)):
        others = np.flatnonzero(sessions[:i] != sessions[i])
        apart = np.abs(crops[others] - crops[i]).mean(axis=(1, 2, 3))
        if len(others) and apart.min() < SAME:
            first = others[apart.argmin()]
            raise UserError(
                f"{folder / LABELS} row {rows[i][0]}: {rows[i][1]['file']} ({sessions[i]}) is the same frame as "
                f"{rows[first][1]['file']} in row {rows[first][0]} ({sessions[first]}); a session must not leak"
            )


def _session(name: str, rows, frames, folder: Path) -> Session:
    mine = [(row, frame) for (_, row), frame in zip(rows, frames, strict=True) if row["session"] == name]
    if {row["hazard"] for row, _ in mine} != {"0", "1"}:
        raise UserError(f"{folder / LABELS}: session {name} needs frames with hazard 1 and with hazard 0")
    return Session(
        np.stack([frame for _, frame in mine]),
        np.array([row["hazard"] == "1" for row, _ in mine]),
        np.array([int(row["placement"]) for row, _ in mine]),
        np.array([float(row["distance_cm"]) for row, _ in mine]),
        np.array([row["lighting"] == "dim" for row, _ in mine]),
    )
