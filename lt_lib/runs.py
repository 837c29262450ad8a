"""The run store: every training is a pure function, computed once and kept in one checked file.

A run is `function(config, seed, report=..., **inputs) -> {name: array, number, text or list}`. It is pure: it
reads no file, keeps no state and draws its randomness from `seed`, so that its key names its result.
"""

import contextlib
import hashlib
import json
import logging
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, as_completed
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import psutil
import safetensors.numpy
from joblib.externals.loky import get_reusable_executor

from lt_lib.files import writable_folder, write_atomically
from lt_lib.params import Settings
from lt_lib.progress import Reporter, stage, write_fraction
from lt_lib.sources import source_digest, source_state

Result = dict[str, Any]

Packed = tuple[bytes, float]  # a packed result and the seconds it took
Submit = Callable[[str, "Run"], "Future[Packed]"]  # has a worker compute a run, given with its key

IDLE_S = 60  # after which a worker without a run ends

# What a result may change with besides our own code.
LIBRARIES = ("torch", "numpy", "scipy", "numba", "mujoco", "scikit-learn", "opencv-python-headless")
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


class RunError(Exception):
    """A run's function raised: the message names the run and the error, which is its cause."""


@dataclass(frozen=True)
class Run:
    """One call of a training: an importable function, its settings, its seed, and results of earlier runs."""

    function: Callable[..., Result]
    config: Settings
    seed: int
    inputs: Mapping[str, Result] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.function.__module__ == "__main__" or "." in self.function.__qualname__:
            raise ValueError(f"{self.function.__qualname__} must be a module's own function for workers to import it")

    def key(self) -> str:
        """sha256 of all that the result depends on: call, contents of inputs, source, library versions."""
        module = sys.modules[self.function.__module__]
        folder = Path(module.__file__).resolve().parents[module.__name__.count(".")]
        parts = {
            "function": f"{self.function.__module__}.{self.function.__qualname__}",
            "config": self.config.model_dump(mode="json"),
            "seed": self.seed,
            "inputs": {name: hashlib.sha256(pack(result)).hexdigest() for name, result in self.inputs.items()},
            "source": source_digest(self.function, type(self.config), folder=folder),
            "libraries": library_versions(),
        }
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def __str__(self) -> str:
        changed = self.config.model_dump(mode="json", exclude_defaults=True, exclude_computed_fields=True)
        settings = "".join(f", {name}={value!r}" for name, value in changed.items())
        return f"{self.function.__name__}(seed={self.seed}{settings})"


@dataclass(frozen=True)
class RunStore:
    """Finished runs in a folder, `<folder>/<function>/<key>.run`, and the workers that compute missing ones.

    workers: processes at a time on this machine, 0 for one a core; or a Dask scheduler's address, such as
    tcp://127.0.0.1:8786, for the workers of its cluster. Each has one thread, so that results do not depend on it.
    """

    folder: Path
    workers: int | str = 0

    def fetch(self, runs: Sequence[Run], what: str) -> list[Result]:
        """The results of `runs` in their order: finished ones are read, the others computed and kept.

        what: a few words for the progress line, e.g. 'route heads'.

        Raises UserError if the folder cannot be written or the cluster not be used, RunError once all else is done
        if any run failed.
        """
        writable_folder(self.folder)
        keys = [run.key() for run in runs]
        wanted = dict(zip(keys, runs, strict=True))
        results = {key: self._read(key, run) for key, run in wanted.items()}
        missing = {key: run for key, run in wanted.items() if results[key] is None}
        if missing:
            self._compute(missing, what)
            results |= {key: self._read(key, run) for key, run in missing.items()}
        return [results[key] for key in keys]

    def _path(self, key: str, run: Run) -> Path:
        return self.folder / run.function.__name__ / f"{key}.run"

    def _read(self, key: str, run: Run) -> Result | None:
        """A finished run's result; None if there is none, or, with a warning, if its file is damaged."""
        path = self._path(key, run)
        if not path.exists():
            return None
        head, _, payload = path.read_bytes().partition(b"\n")
        if head != _checksum(payload):
            logging.getLogger(__name__).warning("%s is truncated or altered: computing %s again", path, run)
            return None
        return unpack(payload)

    def _compute(self, missing: Mapping[str, Run], what: str) -> None:
        """Has workers compute runs, and keeps each as soon as it is done."""
        failures = []
        with (
            stage(self.folder, what, len(missing)) as (progress, finished),
            self._start(missing, progress) as submit,
        ):
            futures = {submit(key, run): key for key, run in missing.items()}
            for future in as_completed(futures):
                key = futures[future]
                if error := self._end(key, missing[key], future):
                    failures.append((missing[key], error))
                finished(key)
        if failures:
            run, error = failures[0]
            reason = f"{type(error).__name__}: {error}"
            raise RunError(f"{len(failures)} of {len(missing)} runs failed, first {run}: {reason}") from error

    def _start(self, missing: Mapping[str, Run], progress: Path) -> AbstractContextManager[Submit]:
        """The workers for some runs, whose progress goes into a folder."""
        if isinstance(self.workers, str):
            from lt_lib.cluster import cluster_workers  # here, since Dask takes a second to import

            return cluster_workers(self.workers, progress)
        source = "".join(sorted({source_state(function) for function in {run.function for run in missing.values()}}))
        return _local_workers(min(self.workers or joblib.cpu_count(), len(missing)), source, progress)

    def _end(self, key: str, run: Run, future: "Future[Packed]") -> BaseException | None:
        """Keeps the result of a run that ended; what went wrong if it has none or cannot be kept."""
        if future.cancelled():
            return ConnectionError(f"lost the scheduler at {self.workers}")
        if error := future.exception():
            return error
        try:
            self._keep(key, run, *future.result())
        except OSError as error:
            return error
        return None

    def _keep(self, key: str, run: Run, payload: bytes, seconds: float) -> None:
        """Writes a run's file, then its line in the journal."""
        write_atomically(self._path(key, run), _checksum(payload) + b"\n" + payload)
        line = {
            "key": key,
            "function": run.function.__name__,
            "config": run.config.model_dump(mode="json"),
            "seed": run.seed,
            "seconds": round(seconds, 3),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        with (self.folder / "journal.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def compute(run: Run, tell: Callable[[float], None]) -> Packed:
    """Computes one run in a worker, which tells how far it is."""
    started = time.perf_counter()
    payload = pack(run.function(run.config, run.seed, report=Reporter(tell), **run.inputs))
    return payload, time.perf_counter() - started


@contextlib.contextmanager
def _local_workers(processes: int, source: str, progress: Path) -> Iterator[Submit]:
    """Worker processes of one thread each, which end with this process, however it ends, and if the block fails.

    They are kept for the next stage, since each takes seconds to start; not if they were started from another
    `source`, because theirs must be the one that was digested.
    """
    pool = get_reusable_executor(
        processes, timeout=IDLE_S, env=ONE_THREAD, initializer=_end_with, initargs=(os.getpid(), source)
    )
    try:
        with warnings.catch_warnings():  # loky replaces a worker that has grown or idled, and says so each time
            warnings.filterwarnings("ignore", message="A worker stopped while some jobs", category=UserWarning)
            yield lambda key, run: pool.submit(compute, run, partial(write_fraction, progress / f"{key}.json"))
    except BaseException:
        pool.shutdown(wait=True, kill_workers=True)
        raise


def _end_with(parent: int, source: str) -> None:
    """Lets this worker end soon after its parent, even after one that was killed; `source` tells it from others."""

    def watch() -> None:
        while os.getppid() == parent and psutil.pid_exists(parent):  # Windows keeps the number of a dead parent
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def pack(result: Result) -> bytes:
    """A result as safetensors bytes, equal for equal results; what is no array goes into the header as json.

    Raises TypeError naming an entry that is neither an array of numbers nor json.
    """
    arrays = {name: value for name, value in result.items() if isinstance(value, np.ndarray)}
    values = {name: value for name, value in result.items() if name not in arrays}
    for name, value in arrays.items():
        if value.dtype.kind not in "biuf":
            raise TypeError(f"result {name!r}: cannot keep an array of {value.dtype}; use numbers, or a list")
        arrays[name] = np.asarray(value, order="C")
    try:
        header = json.dumps(values, sort_keys=True, default=_plain_number)
    except TypeError as error:
        raise TypeError(f"one of the results {sorted(values)}: {error}") from None
    return safetensors.numpy.save(arrays, {"values": header})


def _plain_number(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"cannot keep a {type(value).__name__}; use an array, a number, text or a list")


def unpack(payload: bytes) -> Result:
    """The result that was packed."""
    length = int.from_bytes(payload[:8], "little")
    header = json.loads(payload[8 : 8 + length])
    return safetensors.numpy.load(payload) | json.loads(header["__metadata__"]["values"])


def _checksum(payload: bytes) -> bytes:
    return b"sha256 " + hashlib.sha256(payload).hexdigest().encode()


@cache
def library_versions() -> dict[str, str]:
    """The installed versions of the libraries that a result may depend on."""
    versions = {}
    for name in LIBRARIES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions
