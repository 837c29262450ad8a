"""The store's journal: a line of JSON per computed run and per fetch, appended by every process that uses the store."""

import json
import logging
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

JOURNAL = "journal.jsonl"
ASKED_BY = "LT_ASKED_BY"  # names whoever asks for runs, so that two at once can tell theirs apart


def append(store: Path, line: Mapping[str, Any]) -> None:
    """Adds a line, on a line of its own even behind one that a full disk cut short."""
    path = store / JOURNAL
    with path.open("ab+") as file:
        torn = False
        if file.tell():
            file.seek(-1, os.SEEK_END)
            torn = file.read(1) != b"\n"
        line = {**line, "asked_by": os.environ.get(ASKED_BY, "")}
        file.write((b"\n" if torn else b"") + json.dumps(line).encode() + b"\n")


def lines_since(store: Path, position: int, asked_by: str) -> Iterator[dict[str, Any]]:
    """The lines that someone added since the journal was `position` bytes long; torn ones are skipped, and told."""
    path = store / JOURNAL
    if not path.exists():
        return
    for text in path.read_bytes()[position:].splitlines():
        try:
            line = dict(json.loads(text))
        except (ValueError, TypeError):
            if text.strip():
                logging.getLogger(__name__).warning("%s has a line that was cut short; it is skipped", path)
            continue
        if line.get("asked_by") == asked_by:
            yield line


def length(store: Path) -> int:
    """Bytes in the journal."""
    path = store / JOURNAL
    return path.stat().st_size if path.exists() else 0
