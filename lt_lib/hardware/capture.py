"""Takes labelled frames from an ordinary camera into a folder that notebook 08 reads; see HARDWARE.md.

    python -m lt_lib.hardware.capture FOLDER --crop 210 --session refit --placement 1 --distance 150 \\
        --lighting bright --hazard 1 [--shots 3] [--skip 10] [--source 0]

--source is the camera's number, or a video file. Exit status 0 all well, 2 bad input.
"""

import argparse
import csv
import io
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from lt_lib.hardware.optics import CROP
from lt_lib.hardware.real_frames import COLUMNS, LABELS, OPTICS, WORDS, read_crop, read_rows
from lt_lib.settings.base import UserError
from lt_lib.store.files import writable_folder, write_atomically


def main(arguments: Sequence[str]) -> int:
    options = _parser().parse_args(arguments)
    try:
        files = capture(options)
    except UserError as error:
        print(f"capture: {error}", file=sys.stderr)
        return 2
    print(f"{len(files)} frames: {', '.join(files)}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="capture", description="Takes labelled frames for notebook 08.")
    parser.add_argument("folder", type=Path)
    crop = "side in pixels of the square that subtends 32 degrees, by tape"
    parser.add_argument("--crop", type=int, required=True, help=crop)
    parser.add_argument("--session", choices=WORDS["session"], required=True)
    parser.add_argument("--placement", type=int, required=True, help="a number that is new within the session")
    parser.add_argument("--distance", type=float, required=True, help="cm from the lens to the slab's front")
    parser.add_argument("--lighting", choices=WORDS["lighting"], required=True)
    parser.add_argument("--hazard", choices=WORDS["hazard"], required=True, help="1: the slab blocks this corridor")
    parser.add_argument("--shots", type=int, default=3, help="frames to keep")
    parser.add_argument("--skip", type=int, default=10, help="frames to let pass before each, so that exposure settles")
    parser.add_argument("--source", default="0", help="camera number or video file")
    return parser


def capture(options: argparse.Namespace) -> list[str]:
    """Keeps the frames as PNG and adds their rows to labels.csv; returns the files' names.

    Raises UserError, before writing anything, for a source that cannot be opened or ends too early, a frame smaller
    than the crop, a crop other than the folder states, and a placement that the session already has.
    """
    _check_numbers(options)
    writable_folder(options.folder)
    rows = _earlier(options)
    frames = list(_frames(options.source, options.shots, options.skip))
    height, width = frames[0].shape[:2]
    if not CROP <= options.crop <= min(height, width):
        raise UserError(f"--crop {options.crop} must lie between {CROP} and the frame's {min(height, width)} pixels")
    stem = f"{options.session}_{options.placement:03d}"
    files = [f"{stem}_{i}.png" for i in range(1, len(frames) + 1)]
    for name, frame in zip(files, frames, strict=True):
        write_atomically(options.folder / name, cv2.imencode(".png", frame)[1].tobytes())
    labels = (options.session, options.placement, options.distance, options.lighting, options.hazard)
    write_atomically(options.folder / OPTICS, f"crop: {options.crop}\n".encode())
    write_atomically(options.folder / LABELS, _table([*rows, *((name, *labels) for name in files)]))
    return files


def _check_numbers(options: argparse.Namespace) -> None:
    for name, least in (("shots", 1), ("skip", 0), ("placement", 0), ("distance", 0)):
        value = getattr(options, name)
        if not least <= value < np.inf:
            raise UserError(f"--{name} must be {least} or more, got {value}")


def _earlier(options: argparse.Namespace) -> list[tuple]:
    """The rows that the folder already has."""
    if not (options.folder / LABELS).exists():
        return []
    if read_crop(options.folder) != options.crop:
        raise UserError(f"--crop {options.crop}: {options.folder / OPTICS} states {read_crop(options.folder)}")
    rows = [row for _, row in read_rows(options.folder)]
    taken = {int(row["placement"]) for row in rows if row["session"] == options.session}
    if options.placement in taken:
        raise UserError(f"--placement {options.placement}: session {options.session} already has it; take a new number")
    return [tuple(row[column] for column in COLUMNS) for row in rows]


def _frames(source: str, shots: int, skip: int) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """`shots` frames of a camera or a video file, BGR, after `skip` others each."""
    camera = cv2.VideoCapture(int(source) if source.isdigit() else source)
    if not camera.isOpened():
        raise UserError(f"--source {source}: no camera and no video that OpenCV can open")
    try:
        for taken in range(shots):
            for _ in range(skip):
                camera.grab()
            ok, frame = camera.read()
            if not ok:
                raise UserError(f"--source {source}: ended after {taken} of {shots} shots; take fewer, or skip fewer")
            yield frame
    finally:
        camera.release()


def _table(rows: Sequence[tuple]) -> bytes:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows([COLUMNS, *rows])
    return text.getvalue().encode()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
