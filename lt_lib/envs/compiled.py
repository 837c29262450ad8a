"""Compiled loops that numba keeps between processes, even where neither the checkout nor a home is writable."""

import getpass
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba


def compiled(**options: Any) -> Callable[[Callable], Callable]:
    """A decorator: `numba.njit` with these options, whose compiled code the next process reuses.

    Numba keeps the code beside the source or in the user's cache. Where it can write to neither, the code goes to the
    user's own folder under the system's temporary folder.
    """

    def decorate(function: Callable) -> Callable:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:  # "no locator available"
            numba.config.CACHE_DIR = str(_own_temporary_folder())
            return numba.njit(cache=True, **options)(function)

    return decorate


def _own_temporary_folder() -> Path:
    """A folder that nobody else can write to, because its contents are executed."""
    folder = Path(tempfile.gettempdir()) / f"lt_lib-compiled-{_user()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
        return Path(tempfile.mkdtemp(prefix="lt_lib-compiled-"))
    return folder


def _user() -> str:
    return str(os.getuid()) if hasattr(os, "getuid") else getpass.getuser()
