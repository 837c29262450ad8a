"""Files that stay whole if we are killed, in folders that are ours."""

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
    """Creates a folder if needed. Raises UserError if files cannot be written in it, saying what to do `instead`."""
    if folder.is_symlink() and not folder.exists():
        raise UserError(
            f"{folder} is a link to {os.readlink(folder)}, which does not exist; create that, or remove the link"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))  # a full disk may still have room for an empty file
    except OSError as error:
        raise UserError(f"cannot write in the folder {folder}: {error.strerror}{instead and '; '}{instead}") from None


def write_atomically(path: Path, content: bytes) -> None:
    """Writes a file so that a kill at any time leaves either the whole new file or the old one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)  # half a file would only fill a full disk further


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Claims a folder for this process while the block runs; the claim never outlives the process.

    On a file system without locks it warns and goes on. Raises UserError naming the process that already holds the
    folder, and for another user's claim that this user may not read.
    """
    lock, owner = FileLock(folder / ".claimed", timeout=0), folder / ".claimed.by"
    try:
        lock.acquire()
    except Timeout:
        number = owner.read_text(encoding="utf-8") if owner.is_file() else "of unknown number"
        raise UserError(
            f"process {number} is already writing in {folder}; wait for it or name another folder"
        ) from None
    except PermissionError:
        raise UserError(f"{folder} belongs to another user's run; name another with --outputs") from None
    except (OSError, NotImplementedError) as error:  # filelock's own word for a file system without flock
        reason = f"its file system has no locks ({getattr(error, 'strerror', None) or error})"
        logging.getLogger(__name__).warning("nothing keeps a second run_all.py out of %s: %s", folder, reason)
    try:
        write_atomically(owner, str(os.getpid()).encode())
        yield
    finally:
        lock.release()


def content_digest(content: Mapping[str, Any]) -> str:
    """sha256 of a JSON file's content, stored in the file as `sha256`; layout does not count."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def write_checked(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a JSON file that holds its `content_digest`, whole or not at all; makes its folder.

    Raises a one-line UserError if the folder cannot be written.
    """
    text = json.dumps({"sha256": content_digest(content), **content}, indent=1, ensure_ascii=False) + "\n"
    writable_folder(path.parent)
    write_atomically(path, text.encode())


def outputs_folder(outputs: str, profile: str) -> Path:
    """Where a notebook's outputs go: the given folder, or the project's outputs/<profile> for ''.

    Raises UserError if the notebook is in a different checkout from the library that it imports.
    """
    require_own_checkout(Path.cwd())
    return Path(outputs) if outputs else ROOT / "outputs" / profile


def require_own_checkout(here: Path) -> None:
    """Raises UserError if a folder is in a different checkout from this library, which it would run unknowingly."""
    for folder in (here, *here.parents):
        if (folder / "lt_lib" / "__init__.py").is_file() and folder.resolve() != ROOT:
            raise UserError(
                f"this notebook is in {folder}, but the library that it imports is in {ROOT}; "
                f"start Jupyter with PYTHONPATH={folder}, or `pip install -e {folder}`"
            )


def runs_folder(root: Path = ROOT) -> Path:
    """Where finished runs are stored: the folder named by the environment's LT_RUNS, or the project's outputs/runs."""
    named = os.environ.get("LT_RUNS")
    return Path(named) if named else root / "outputs" / "runs"


def kept_folder(root: Path = ROOT) -> Path | None:
    """Where a release keeps runs for notebooks opened by hand; None where LT_RUNS names the only folder to look in.

    `run_all.py` always names one, so that it computes from nothing.
    """
    return None if os.environ.get("LT_RUNS") else root / "outputs" / "kept"
