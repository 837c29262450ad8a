"""Files that are whole whenever we are killed, in folders that are ours."""

import contextlib
import hashlib
import json
import logging
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from lt_lib.settings.base import ROOT, UserError


def writable_folder(folder: Path, instead: str = "") -> None:
    """Makes a folder if need be. Raises UserError if files cannot be written in it, saying what to do `instead`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))  # on a full disk there may still be room for an empty one
    except OSError as error:
        raise UserError(f"cannot write in the folder {folder}: {error.strerror}{instead and '; '}{instead}") from None


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

    On a file system without locks it warns and goes on. Raises UserError naming the process
    that has it already, and for another user's claim that this one may not read.
    """
    lock, owner = FileLock(folder / ".claimed", timeout=0), folder / ".claimed.by"
    try:
        lock.acquire()
    except Timeout:
        number = owner.read_text(encoding="utf-8") if owner.is_file() else "of an unknown number"
        raise UserError(
            f"process {number} is already writing in {folder}; wait for it or name another folder"
        ) from None
    except PermissionError:
        raise UserError(f"{folder} belongs to another user's run; name another folder by --outputs") from None
    except OSError as error:
        reason = f"its file system has no locks ({error.strerror})"
        logging.getLogger(__name__).warning("nothing keeps a second run_all.py out of %s: %s", folder, reason)
    try:
        write_atomically(owner, str(os.getpid()).encode())
        yield
    finally:
        lock.release()


def content_digest(content: Mapping[str, Any]) -> str:
    """sha256 of what a json file holds, which stands in it as its `sha256`; how it is laid out does not count."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def outputs_folder(outputs: str, profile: str) -> Path:
    """Where a notebook's outputs go: the folder it was given, or outputs/<profile> of the project for ''.

    Raises UserError where the notebook lies in another checkout than the library that it imports.
    """
    require_own_checkout(Path.cwd())
    return Path(outputs) if outputs else ROOT / "outputs" / profile


def require_own_checkout(here: Path) -> None:
    """Raises UserError if a folder lies in another checkout than this library, which it would run unawares."""
    for folder in (here, *here.parents):
        if (folder / "lt_lib" / "__init__.py").is_file() and folder.resolve() != ROOT:
            raise UserError(
                f"this notebook lies in {folder}, the library that it imports in {ROOT}; "
                f"start Jupyter with PYTHONPATH={folder}, or `pip install -e {folder}`"
            )


def runs_folder(root: Path = ROOT) -> Path:
    """Where finished runs are kept: the folder that the environment's LT_RUNS names, or outputs/runs of a project."""
    named = os.environ.get("LT_RUNS")
    return Path(named) if named else root / "outputs" / "runs"
