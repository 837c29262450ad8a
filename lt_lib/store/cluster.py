"""A Dask cluster as workers: a worker computes a run only if its result would equal ours.

Everything that a result depends on is compared twice: for all workers before computing starts, and by the worker for
each run, since workers may join and files may change later.
"""

import contextlib
import hashlib
import logging
import os
import re
import socket
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from importlib import metadata
from pathlib import Path
from typing import Any

import dask
import distributed
import threadpoolctl

from lt_lib.settings.base import UserError
from lt_lib.settings.devices import computing_device
from lt_lib.store.local import ONE_THREAD
from lt_lib.store.progress import write_fraction
from lt_lib.store.run import Packed, Run, Submit, compute, library_versions

OURS = "latent-telepathy-compendium"
ADDRESS = re.compile(r"(tcp|tls)://(\[[0-9a-fA-F:.]+\]|[\w.-]+):\d{1,5}")
ANSWER_S = 10  # seconds within which a scheduler must answer and have a worker
LONGEST_HANDSHAKE = 2**20  # bytes
TLS = "distributed.comm.tls"  # where Dask's configuration has the certificates
TOPIC = "latent-telepathy-progress"


def require_address(address: str) -> None:
    """Raises UserError for an invalid scheduler address."""
    if not ADDRESS.fullmatch(address):
        raise UserError(f"expected a scheduler's address such as tcp://127.0.0.1:8786, got {address!r}")


def code_digest() -> str:
    """The first 12 digits of the sha256 of the library's files on this process's disk."""
    folder = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        text = path.read_text(encoding="utf-8")  # line endings do not count
        digest.update(f"{path.relative_to(folder).as_posix()}\n{text}\0".encode())
    return digest.hexdigest()[:12]


LOADED = code_digest()  # a long-lived worker keeps running the code it started with


def identity() -> dict[str, str]:
    """What this process computes with, by name: our version and code, and library versions."""
    try:
        version = metadata.version(OURS)
    except metadata.PackageNotFoundError:
        version = "not installed"
    now = code_digest()
    edited = "" if now == LOADED else f", since edited to {now}"
    return {OURS: f"{version} (code {LOADED}{edited})", **library_versions()}


def require_same(expected: Mapping[str, str], found: Mapping[str, str], worker: str) -> None:
    """Raises UserError naming both versions if a worker's differs from ours."""
    for name, version in expected.items():
        if found.get(name) != version:
            theirs = f"{name} {found[name]}" if name in found else f"no {name}"
            raise UserError(f"worker {worker} has {theirs}, expected {version}; start it with this version")


@contextlib.contextmanager
def connected(address: str) -> Iterator[distributed.Client]:
    """A client of a scheduler whose workers have one thread each and our versions.

    Raises a one-line UserError for a bad address, no answer, no workers or an unfit worker.
    """
    require_address(address)
    _require_scheduler(address)
    try:
        with _quiet():
            client = distributed.Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise UserError(f"no Dask scheduler answers at {address} ({type(error).__name__}); is it running?") from None
    with client:
        _require_workers(client, address)
        yield client


def _require_scheduler(address: str) -> None:
    """Raises UserError unless something at the address greets as a Dask scheduler does; a client would wait forever."""
    kind, _, place = address.partition("://")
    host, _, port = place.rpartition(":")
    missing = [name for name in ("ca-file", "client.cert", "client.key") if not dask.config.get(f"{TLS}.{name}", None)]
    if kind == "tls" and missing:
        names = ", ".join(f"DASK_{f'{TLS}.{name}'.upper().replace('.', '__').replace('-', '_')}" for name in missing)
        raise UserError(f"{address}: TLS needs certificates; give their files in {names}")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWER_S) as peer:
            greeting = peer.recv(8, socket.MSG_WAITALL) if kind == "tcp" else b""  # over TLS the client speaks first
    except TimeoutError:
        raise UserError(f"no Dask scheduler answers at {address} within {ANSWER_S} s; is that its port?") from None
    except OSError as error:
        raise UserError(f"no Dask scheduler answers at {address} ({error.strerror or error}); is it running?") from None
    # a scheduler begins with the length of its handshake, and a client would allocate whatever else stands there
    if kind == "tcp" and not 0 < int.from_bytes(greeting, "little") < LONGEST_HANDSHAKE:
        raise UserError(f"no Dask scheduler answers at {address}, but something else; give the scheduler's own port")


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silences Dask's log, since our own message reports a failed connection."""
    logger = logging.getLogger("distributed")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


def _require_workers(client: distributed.Client, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=ANSWER_S)
    except TimeoutError:
        raise UserError(
            f"the scheduler at {address} has no workers; start some with `dask worker {address} --nthreads 1`"
        ) from None
    for worker, threads in client.nthreads().items():
        if threads != 1:
            raise UserError(f"worker {worker} has {threads} threads; start it with --nthreads 1")
    expected = identity()
    for worker, found in client.run(identity, on_error="return").items():
        if isinstance(found, BaseException):
            reason = f"{type(found).__name__}: {found}"
            raise UserError(f"worker {worker} cannot load {OURS} ({reason}), expected {expected[OURS]}")
        require_same(expected, found, worker)


@contextlib.contextmanager
def cluster_workers(address: str, progress: Path) -> Iterator[Submit]:
    """The workers of a cluster. A run whose worker is lost is computed by another, up to Dask's allowed failures.

    Raises UserError as `connected` does.
    """
    with connected(address) as client:
        ours: set[str] = set()

        def tell(event: tuple[float, Mapping[str, Any]]) -> None:
            key, fraction = event[1]["key"], event[1]["fraction"]
            if key in ours:
                write_fraction(progress / f"{key}.json", fraction)

        def submit(key: str, run: Run) -> Future:
            ours.add(key)
            future = executor.submit(compute_there, run, key, expected)
            future.add_done_callback(lambda _: ours.discard(key))
            return future

        client.subscribe_topic(TOPIC, tell)
        expected, executor = identity(), client.get_executor(pure=False)
        yield submit


def compute_there(run: Run, key: str, expected: Mapping[str, str]) -> Packed:
    """Computes one run in a worker of a cluster.

    Raises UserError if the worker's versions, code or layouts differ from those of the key, or if it lacks the device
    that the key names.
    """
    worker = distributed.get_worker()
    require_same(expected, identity(), worker.address)
    if "device" in type(run.config).model_fields:
        require_device(run.config.device, worker.address)
    if run.key() != key:
        raise UserError(f"worker {worker.address} has different source or a different layout for {run}; update it")
    with one_thread():
        return compute(run, lambda fraction: worker.log_event(TOPIC, {"key": key, "fraction": fraction}))


def require_device(device: str, worker: str) -> None:
    """Raises UserError naming this worker if it lacks a device."""
    try:
        computing_device(device)
    except UserError as error:
        raise UserError(f"worker {worker}: {error}") from None


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Limits this process's numerical libraries to one thread, whether already loaded or not."""
    # Once loaded, numba refuses any value but the one it found.
    unread = [name for name in ONE_THREAD if name != "NUMBA_NUM_THREADS" or "numba" not in sys.modules]
    os.environ.update({name: ONE_THREAD[name] for name in unread})
    for library in {"torch", "numba"} & set(sys.modules):
        sys.modules[library].set_num_threads(1)
    with threadpoolctl.threadpool_limits(1):
        yield
