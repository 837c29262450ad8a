"""Files that are whole whenever we are killed, in folders that are ours."""

import contextlib
import fcntl
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lt_lib.params import ROOT, UserError


def writable_folder(folder: Path) -> None:
    """Makes a folder if need be. Raises UserError if files cannot be written in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))  # on a full disk there may still be room for an empty one
    except OSError as error:
        raise UserError(f"cannot write in the folder {folder}: {error.strerror}") from None


def write_atomically(path: Path, content: bytes) -> None:
    """Writes a file so that, whenever we are killed, either all of it is there or the old one still is."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)  # half of it would fill a full disk further


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Claims a folder for this process while the block runs, and until its death at the latest.

    Raises UserError naming the process that has it already.
    """
    with (folder / ".claimed").open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise UserError(
                f"process {file.read()} is already writing in {folder}; wait for it or name another folder"
            ) from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def content_digest(content: Mapping[str, Any]) -> str:
    """sha256 of what a json file holds, which stands in it as its `sha256`; how it is laid out does not count."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def outputs_folder(outputs: str, profile: str) -> Path:
    """Where a notebook's outputs go: the folder it was given, or outputs/<profile> of the project for ''."""
    return Path(outputs) if outputs else ROOT / "outputs" / profile
