"""Worker processes on this machine, one thread each, so that results do not depend on their number."""

import contextlib
import os
import threading
import time
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import joblib
import psutil
from joblib.externals.loky import get_reusable_executor

from lt_lib.settings.base import UserError
from lt_lib.store.progress import write_fraction
from lt_lib.store.run import Submit, compute

IDLE_S = 60  # after which an idle worker exits
ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "MKL_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "NUMBA_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    ),
    "1",
)


def cores() -> int:
    """The cores that this process may use. Raises a one-line UserError for an unusable LOKY_MAX_CPU_COUNT."""
    try:
        return joblib.cpu_count()
    except ValueError:
        given = os.environ.get("LOKY_MAX_CPU_COUNT")
        raise UserError(f"LOKY_MAX_CPU_COUNT: expected a whole number of cores, at least 1, got {given!r}") from None


@contextlib.contextmanager
def local_workers(processes: int, source: str, progress: Path) -> Iterator[Submit]:
    """Worker processes of one thread each, which end with this process, however it ends, and if the block fails.

    They are kept for the next stage, since each takes seconds to start, unless they were started from another `source`:
    workers must run the source that was digested.
    """
    try:
        pool = get_reusable_executor(
            processes, timeout=IDLE_S, env=ONE_THREAD, initializer=_end_with, initargs=(os.getpid(), source)
        )
    except OSError as error:  # semaphores live there on Linux
        raise UserError(f"cannot start worker processes ({error.strerror}); they need a writable /dev/shm") from None
    try:
        with warnings.catch_warnings():  # loky warns whenever it replaces a worker that has grown or idled
            warnings.filterwarnings("ignore", message="A worker stopped while some jobs", category=UserWarning)
            yield lambda key, run: pool.submit(compute, run, partial(write_fraction, progress / f"{key}.json"))
    except BaseException:
        pool.shutdown(wait=True, kill_workers=True)
        raise


def _end_with(parent: int, source: str) -> None:
    """Ends this worker soon after its parent, even a killed parent; `source` tells it from other workers."""

    def watch() -> None:
        while os.getppid() == parent and psutil.pid_exists(parent):  # Windows keeps a dead parent's id
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
