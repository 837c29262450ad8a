"""Files that are whole whenever we are killed."""

import os
import tempfile
from pathlib import Path

from lt_lib.params import ROOT, UserError


def writable_folder(folder: Path) -> None:
    """Makes a folder if need be. Raises UserError if files cannot be written in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise UserError(f"cannot write in the folder {folder}: {error.strerror}") from None


def write_atomically(path: Path, content: bytes) -> None:
    """Writes a file so that, whenever we are killed, either all of it is there or the old one still is."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    with temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def outputs_folder(outputs: str, profile: str) -> Path:
    """Where a notebook's outputs go: the folder it was given, or outputs/<profile> of the project for ''."""
    return Path(outputs) if outputs else ROOT / "outputs" / profile
