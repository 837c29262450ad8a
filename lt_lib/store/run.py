"""A run: one training as a pure function, the key that names its result, and its result as bytes.

A run is `function(config, seed, report=..., **inputs) -> {name: array, number, text or list}`. It is pure: it
reads no file, keeps no state and draws its randomness from `seed`, so that its key names its result.
"""

import contextlib
import hashlib
import json
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from lt_lib.settings.base import Settings, UserError
from lt_lib.store.computer import computer
from lt_lib.store.progress import Reporter
from lt_lib.store.sources import source_digest

Result = dict[str, Any]

Packed = tuple[bytes, float, str]  # a packed result, the seconds it took, and the computer
Submit = Callable[[str, "Run"], "Future[Packed]"]  # has a worker compute a run, given its key

# What a result may depend on besides our own code.
LIBRARIES = ("torch", "numpy", "scipy", "numba", "mujoco", "scikit-learn", "opencv-python-headless")


@dataclass(frozen=True)
class LeftOut:
    """The place of an array that a release leaves out: its digest, which still names the runs that start from it."""

    digest: str

    @classmethod
    def of(cls, array: np.ndarray) -> "LeftOut":
        """An array's place; the digest is the sha256 of its type, shape and contents."""
        return cls(hashlib.sha256(f"{array.dtype.str} {array.shape} ".encode() + array.tobytes()).hexdigest())

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        raise UserError(
            "the release leaves these weights out; `python run_all.py --only` with this notebook makes them"
        )


@dataclass(frozen=True)
class Run:
    """One call of a training: an importable function, its settings, its seed, and results of earlier runs."""

    function: Callable[..., Result]
    config: Settings
    seed: int
    inputs: Mapping[str, Result] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.function.__module__ == "__main__" or "." in self.function.__qualname__:
            raise ValueError(f"{self.function.__qualname__} must be a module-level function for workers to import")

    def key(self) -> str:
        """sha256 of everything that the result depends on: call, contents of inputs, source, library versions."""
        module = sys.modules[self.function.__module__]
        folder = Path(module.__file__).resolve().parents[module.__name__.count(".")]
        parts = {
            "function": f"{self.function.__module__}.{self.function.__qualname__}",
            "config": self.config.model_dump(mode="json"),
            "seed": self.seed,
            "inputs": {name: hashlib.sha256(pack(bare(result))).hexdigest() for name, result in self.inputs.items()},
            "source": source_digest(self.function, type(self.config), folder=folder),
            "libraries": library_versions(),
        }
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def __str__(self) -> str:
        changed = self.config.model_dump(mode="json", exclude_defaults=True, exclude_computed_fields=True)
        settings = "".join(f", {name}={value!r}" for name, value in changed.items())
        return f"{self.function.__name__}(seed={self.seed}{settings})"


def compute(run: Run, tell: Callable[[float], None]) -> Packed:
    """Computes one run in a worker, which reports its progress."""
    started = time.perf_counter()
    payload = pack(run.function(run.config, run.seed, report=Reporter(tell), **run.inputs))
    return payload, time.perf_counter() - started, computer()


def bare(result: Result) -> Result:
    """The result with all of its arrays left out, which tells its contents as well."""
    return {name: LeftOut.of(_numeric(name, value)) if _is_array(value) else value for name, value in result.items()}


def pack(result: Result) -> bytes:
    """A result as safetensors bytes, equal for equal results; everything but arrays goes into the header as JSON.

    Raises TypeError naming an entry that is neither a numeric array nor JSON.
    """
    arrays = {name: _numeric(name, value) for name, value in result.items() if _is_array(value)}
    values = {name: value for name, value in result.items() if name not in arrays}
    try:
        header = json.dumps(values, sort_keys=True, default=_plain)
    except TypeError as error:
        raise TypeError(f"one of the results {sorted(values)}: {error}") from None
    return safetensors.numpy.save(arrays, {"values": header})


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray)


def _numeric(name: str, array: np.ndarray) -> np.ndarray:
    """The array, contiguous; raises TypeError if it holds anything but numbers."""
    if array.dtype.kind not in "biuf":
        raise TypeError(f"result {name!r}: cannot store an array of {array.dtype}; use numbers or a list")
    return np.asarray(array, order="C")


def _plain(value: Any) -> Any:
    """What JSON writes for a value of ours."""
    if isinstance(value, LeftOut):
        return {"left out": value.digest}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"cannot store a {type(value).__name__}; use an array, a number, text or a list")


def _ours(entry: dict[str, Any]) -> Any:
    """Undoes `_plain`."""
    return LeftOut(entry["left out"]) if entry.keys() == {"left out"} else entry


def unpack(payload: bytes) -> Result:
    """The result in packed bytes."""
    length = int.from_bytes(payload[:8], "little")
    header = json.loads(payload[8 : 8 + length])
    return safetensors.numpy.load(payload) | json.loads(header["__metadata__"]["values"], object_hook=_ours)


@cache
def library_versions() -> dict[str, str]:
    """The installed versions of the libraries that a result may depend on."""
    versions = {}
    for name in LIBRARIES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions
