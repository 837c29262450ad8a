"""Compiled loops that numba keeps between processes, for as long as the source that went into them stands."""

import getpass
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

from lt_lib.store.sources import source_digest

GIVEN = numba.config.CACHE_DIR  # by the user, in NUMBA_CACHE_DIR


def compiled(**options: Any) -> Callable[[Callable], Callable]:
    """A decorator: `numba.njit` with these options, whose compiled code the next process reuses.

    Numba itself looks at the date of the function's own file, while constants of other modules are frozen into the
    code. So the code is kept under a digest of the module and of all of ours that it imports, and an edit of any of
    them compiles anew.

    It is kept beside the source, or where NUMBA_CACHE_DIR says. Where neither can be written to, it goes to the user's
    own folder under the system's temporary folder.
    """

    def decorate(function: Callable) -> Callable:
        module = sys.modules[function.__module__]
        source = Path(module.__file__).resolve()
        digest = source_digest(function, folder=source.parents[module.__name__.count(".")])
        place = Path(GIVEN) if GIVEN else source.parent / "__pycache__"
        kept = f"compiled-{module.__name__}-{digest[:16]}"
        try:
            return _kept_in(place / kept, function, options)
        except OSError:  # not writable
            return _kept_in(_own_temporary_folder() / kept, function, options)

    return decorate


def _kept_in(folder: Path, function: Callable, options: dict[str, Any]) -> Callable:
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):  # numba would only notice when it writes
        numba.config.CACHE_DIR = str(folder)
    return numba.njit(cache=True, **options)(function)


def _own_temporary_folder() -> Path:
    """A folder that nobody else can write to, because its contents are executed."""
    folder = Path(tempfile.gettempdir()) / f"lt_lib-compiled-{_user()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
        return Path(tempfile.mkdtemp(prefix="lt_lib-compiled-"))
    return folder


def _user() -> str:
    return str(os.getuid()) if hasattr(os, "getuid") else getpass.getuser()
