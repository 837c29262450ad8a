"""Progress of the runs in flight, reported through small files, since each runs in its own process.

`<store>/inflight/<process>/stage.json` describes one fetch, `<key>.json` beside it one of its runs.
"""

import contextlib
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree
from typing import Any

import psutil
from tqdm import tqdm


class Reporter:
    """What a run calls with its fraction done, 0 to 1; passes it on to `tell` at most twice per second."""

    def __init__(self, tell: Callable[[float], None]) -> None:
        self._tell = tell
        self._told = float("-inf")

    def __call__(self, fraction: float) -> None:
        if time.monotonic() - self._told > 0.5:
            self._tell(float(fraction))
            self._told = time.monotonic()


def write_fraction(path: Path, fraction: float) -> None:
    """Writes a run's fraction done to its file."""
    _write(path, {"fraction": fraction})


@contextlib.contextmanager
def stage(folder: Path, what: str, total: int) -> Iterator[tuple[Path, Callable[[str], None]]]:
    """Reports on `total` runs until the block ends: (folder for reporters' files, to call with a finished key).

    On a terminal it also draws a bar.
    """
    files = folder / "inflight" / str(os.getpid())
    files.mkdir(parents=True, exist_ok=True)
    _forget_ended(files.parent)
    told = {"what": what, "done": 0, "total": total, "started": time.monotonic()}

    def finished(key: str) -> None:
        told["done"] += 1
        _write(files / "stage.json", told)
        (files / f"{key}.json").unlink(missing_ok=True)
        bar.update()

    _write(files / "stage.json", told)
    with tqdm(desc=what, total=total, disable=None) as bar:
        try:
            yield files, finished
        finally:
            rmtree(files, ignore_errors=True)


@dataclass(frozen=True)
class Progress:
    """State of a fetch: runs done, the fraction including those in flight, seconds so far and left."""

    what: str
    done: int
    total: int
    fraction: float
    seconds: float
    left: float | None


def read_progress(folder: Path, since: float) -> Progress | None:
    """The latest fetch in a store, if it started at or after `since` (seconds of `time.monotonic`)."""
    alive = [path for path in folder.glob("inflight/*/stage.json") if psutil.pid_exists(int(path.parent.name))]
    stages = [(told["started"], path, told) for path in alive if (told := _read(path))]
    started, path, told = max(stages, default=(0.0, None, None), key=lambda stage: stage[0])
    if path is None or started < since:
        return None
    in_flight = [_read(run).get("fraction", 0.0) for run in path.parent.glob("*.json") if run != path]
    fraction = (told["done"] + sum(in_flight)) / told["total"]
    seconds = time.monotonic() - started
    left = seconds * (1 - fraction) / fraction if fraction > 0 else None
    return Progress(told["what"], told["done"], told["total"], fraction, seconds, left)


def _forget_ended(inflight: Path) -> None:
    """Removes the files of killed processes."""
    for files in inflight.iterdir():
        if not psutil.pid_exists(int(files.name)):
            rmtree(files, ignore_errors=True)


def _write(path: Path, content: dict[str, Any]) -> None:
    """Writes a file if possible; losing it costs nothing, and a full disk must not cost a run."""
    with contextlib.suppress(OSError):
        temporary = path.with_suffix(".new")
        temporary.write_text(json.dumps(content), encoding="utf-8")
        temporary.replace(path)


def _read(path: Path) -> dict[str, Any]:
    """A file's content; empty if it has vanished or is damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return {}
