"""Loops that numba compiles once and keeps, also where neither the checkout nor a home can be written."""

import getpass
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba


def compiled(**options: Any) -> Callable[[Callable], Callable]:
    """A decorator: `numba.njit` with its options, and the compiled code kept for the next process.

    numba keeps it beside the source or in the user's cache; where it can write neither, it goes into a folder of the
    user's own under the system's temporary one.
    """

    def decorate(function: Callable) -> Callable:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:  # "no locator available"
            numba.config.CACHE_DIR = str(_own_temporary_folder())
            return numba.njit(cache=True, **options)(function)

    return decorate


def _own_temporary_folder() -> Path:
    """A folder that nobody else can write, since what is kept there is executed."""
    folder = Path(tempfile.gettempdir()) / f"lt_lib-compiled-{_user()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
        return Path(tempfile.mkdtemp(prefix="lt_lib-compiled-"))
    return folder


def _user() -> str:
    return str(os.getuid()) if hasattr(os, "getuid") else getpass.getuser()
