"""Frames of a real camera (Section Hardware): a folder of pictures with their labels, checked row by row.

    labels.csv   file,session,placement,distance_cm,lighting,hazard     one row per decision
    optics.yaml  crop: 210       side in pixels of the central square that subtends 32 degrees, by tape
    *.png *.jpg  all of one size

`session` is refit, validation or live, `placement` a whole number, `lighting` bright or dim, `hazard` 1 or 0.
"""

import csv
import io
import re
import struct
import warnings
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageCms, ImageOps, UnidentifiedImageError

from lt_lib.hardware.optics import CROP, crop
from lt_lib.hardware.sessions import Session
from lt_lib.settings.base import UserError, require_known
from lt_lib.settings.strict_yaml import read_yaml

LABELS, OPTICS = "labels.csv", "optics.yaml"
COLUMNS = ("file", "session", "placement", "distance_cm", "lighting", "hazard")
SESSIONS = ("refit", "validation", "live")
WORDS = {"session": SESSIONS, "lighting": ("bright", "dim"), "hazard": ("0", "1")}
SUFFIXES = (".png", ".jpg", ".jpeg")
MOST_PIXELS = 50_000_000  # of a picture
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
    if not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
        raise UserError(f"{path} is missing; it states 'crop: <side in pixels that subtends 32 degrees>' (HARDWARE.md)")
    stated = read_yaml(path)
    side = stated.get("crop") if isinstance(stated, dict) and set(stated) == {"crop"} else None
    if type(side) is not int or side < CROP:
        raise UserError(f"{path}: expected one line 'crop: <whole number of pixels, at least {CROP}>', got {stated!r}")
    return side


def read_rows(folder: Path) -> list[tuple[int, dict[str, str]]]:
    """(row number as a spreadsheet shows it, row) of every label. Raises UserError for an invalid row."""
    path = folder / LABELS
    records = _records(path)
    header = next((record for _, record in records), [])
    _check_header(header, f"{path} row 1")
    rows = []
    for number, record in records[1:]:
        if len(record) != len(COLUMNS):
            raise UserError(
                f"{path} row {number}: expected {len(COLUMNS)} values, got {len(record)}; a decimal comma makes two, "
                "write 120.5"
            )
        rows.append((number, dict(zip(COLUMNS, record, strict=True))))
    if not rows:
        raise UserError(f"{path} has no rows")
    seen: dict[str, int] = {}
    for number, row in rows:
        _check_row(row, folder, f"{path} row {number}")
        first = seen.setdefault(row["file"], number)
        if first != number:
            raise UserError(f"{path} row {number}: {row['file']} is there twice, first in row {first}")
    _check_placements(path, rows)
    return rows


def _records(path: Path) -> list[tuple[int, list[str]]]:
    """(row number, values) of every row that is not blank."""
    if not path.is_file() or not path.resolve().is_relative_to(path.parent.resolve()):
        raise UserError(f"{path} is missing; it has the columns {','.join(COLUMNS)}")
    content = path.read_bytes()
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise UserError(f"{path} is UTF-16; save it as 'CSV UTF-8'")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = content[: error.start].count(b"\n") + 1
        raise UserError(f"{path} row {row} is not UTF-8; save the file as 'CSV UTF-8'") from None
    try:
        records = list(enumerate(csv.reader(text.splitlines(), strict=True), start=1))
    except csv.Error as error:
        raise UserError(f"{path}: not a table of values between commas ({error})") from None
    return [(number, record) for number, record in records if record]


def _check_header(header: list[str], where: str) -> None:
    if tuple(header) == COLUMNS:
        return
    wanted, remedy = ",".join(COLUMNS), ""
    if len(header) == 1 and header[0].count(";") >= len(COLUMNS) - 1:
        remedy = "; save it with commas between the values, not semicolons"
    elif tuple(word.strip() for word in header) == COLUMNS:
        remedy = "; remove the spaces beside the commas"
    raise UserError(f"{where}: expected the columns {wanted}, got {','.join(header)!r}{remedy}")


def _check_row(row: Mapping[str, str], folder: Path, where: str) -> None:
    for column, value in row.items():
        if value != value.strip():
            raise UserError(f"{where}: {column} {value!r} has a space beside the comma; remove it")
    for column, words in WORDS.items():
        require_known([row[column]], words, column, f"{where}: ")
    if not re.fullmatch(r"[0-9]{1,9}", row["placement"]):
        raise UserError(f"{where}: placement must be a whole number, at least 0, got {row['placement']!r}")
    if not re.fullmatch(r"[0-9]{1,6}(\.[0-9]*)?", row["distance_cm"]) or float(row["distance_cm"]) == 0:
        raise UserError(f"{where}: distance_cm must be a distance in cm, above 0, got {row['distance_cm']!r}")
    if not row["file"].lower().endswith(SUFFIXES):
        raise UserError(f"{where}: {row['file']!r} is neither PNG nor JPEG ({', '.join(SUFFIXES)})")
    _check_inside(folder, row["file"], where)


def _check_inside(folder: Path, name: str, where: str) -> None:
    """Raises UserError unless a name is that of a file in the folder; nothing outside it is opened."""
    try:
        path = (folder / name).resolve()
        inside = path.is_relative_to(folder.resolve()) and not Path(name).is_absolute()
        there = inside and path.is_file()
    except (ValueError, OSError, RuntimeError):  # a null byte, a name that is too long, a link to itself
        raise UserError(f"{where}: {name!r} is no file name") from None
    if not inside:
        raise UserError(f"{where}: {name!r} lies outside the folder; copy the picture into it")
    if not there:
        raise UserError(f"{where}: {name} is missing")


def _check_placements(path: Path, rows: list[tuple[int, dict[str, str]]]) -> None:
    """Raises UserError for a placement of a session that is described in two ways: it is the robot put down once."""
    first: dict[tuple[str, int], tuple[int, dict[str, str]]] = {}
    for number, row in rows:
        earlier, same = first.setdefault((row["session"], int(row["placement"])), (number, row))
        for column, kind in (("hazard", str), ("distance_cm", float), ("lighting", str)):
            if kind(row[column]) != kind(same[column]):
                raise UserError(
                    f"{path} row {number}: placement {row['placement']} has {column} {row[column]}, but {same[column]} "
                    f"in row {earlier}; number every placement of a session anew"
                )


def _read_picture(path: Path, where: str) -> UInt8[np.ndarray, "h w 3"]:
    """RGB, upright and in sRGB, 8 bits per channel; HARDWARE.md says what is done to other pictures.

    Raises UserError for what is no picture, what is too large or transparent, and for one whose end is missing.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=("PNG", "JPEG")) as image:
                if image.width * image.height > MOST_PIXELS:
                    raise Image.DecompressionBombError
                image.load()
                return np.asarray(_srgb(ImageOps.exif_transpose(image), where))
    except UnidentifiedImageError:
        raise UserError(f"{where} is no image in PNG or JPEG format") from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise UserError(f"{where} has more than {MOST_PIXELS:,} pixels; scale it down") from None
    except (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error) as error:  # for a file that is cut
        raise UserError(f"{where} is truncated or damaged ({error})") from None


def _srgb(image: Image.Image, where: str) -> Image.Image:
    """8-bit RGB in sRGB. Raises UserError for a picture that cannot be converted without guessing."""
    layered = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
    if layered and np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
        raise UserError(f"{where} has transparent pixels; save it without an alpha channel")
    if image.mode.startswith("I"):  # 16 bits of grey, as Pillow reads them
        grey = np.asarray(image).astype(np.int64)
        return Image.fromarray((np.clip(grey, 0, 65535) // 257).astype(np.uint8)).convert("RGB")
    if image.mode not in ("RGB", "RGBA", "L", "LA", "P", "PA", "1"):
        raise UserError(f"{where} is in {image.mode}; save it as RGB")
    profile, converted = image.info.get("icc_profile"), image.convert("RGB")
    if not profile:
        return converted
    try:
        own = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if own.profile.xcolor_space.strip() != "RGB":  # a grey profile of a picture that is RGB by now
            return converted
        return ImageCms.profileToProfile(converted, own, ImageCms.createProfile("sRGB"))
    except (ImageCms.PyCMSError, OSError) as error:
        raise UserError(f"{where} has an unusable colour profile ({error}); save it in sRGB") from None


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
