"""The run store: every training is computed once, locally or on a cluster, and stored in one checked file."""

import hashlib
import logging
import lzma
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, as_completed
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from lt_lib.store import journal
from lt_lib.store.files import kept_folder, writable_folder, write_atomically
from lt_lib.store.local import cores, local_workers
from lt_lib.store.progress import stage
from lt_lib.store.run import Packed, Result, Run, Submit, unpack
from lt_lib.store.sources import source_state

COMPRESSED = ".xz"  # the ending of a kept run's file


class RunError(Exception):
    """A run's function raised; the message names the run and the error, which is the cause."""


@dataclass(frozen=True)
class RunStore:
    """Finished runs in a folder, `<folder>/<function>/<key>.run`, and the workers that compute missing ones.

    workers: processes at a time on this machine, 0 for one per core; or a Dask scheduler's address, such as
    tcp://127.0.0.1:8786, for the workers of its cluster. Each has one thread, so results do not depend on the choice.
    kept: a release's runs, compressed, which are read where the folder lacks them; see `store.kept`
    """

    folder: Path
    workers: int | str = 0
    kept: Path | None = field(default_factory=kept_folder)

    def fetch(self, runs: Sequence[Run], what: str) -> list[Result]:
        """The results of `runs`, in order: finished ones are read, the others computed and stored.

        what: a few words for the progress line, e.g. 'route heads'.

        Raises UserError if the folder is not writable or the cluster unusable; RunError if any run failed, after all
        others have finished.
        """
        writable_folder(self.folder)
        keys = [run.key() for run in runs]
        wanted = dict(zip(keys, runs, strict=True))
        kept = {key: self._read(key, run) for key, run in wanted.items()}
        missing = {key: run for key, run in wanted.items() if kept[key] is None}
        if missing:
            self._compute(missing, what)
            kept |= {key: self._read(key, run) for key, run in missing.items()}
        names = [self._path(key, run).relative_to(self.folder).as_posix() for key, run in wanted.items()]
        made_on = sorted({made_on for _, made_on in kept.values()})
        journal.append(self.folder, {"fetched": what, "runs": names, "computers": made_on})
        return [kept[key][0] for key in keys]

    def _path(self, key: str, run: Run) -> Path:
        return self.folder / run.function.__name__ / f"{key}.run"

    def _read(self, key: str, run: Run) -> tuple[Result, str] | None:
        """A finished run's result and the computer that made it; None if its file is missing or, warned of, damaged."""
        path = self._path(key, run)
        own = checked(path.read_bytes()) if path.exists() else None
        if path.exists() and not own:
            logging.getLogger(__name__).warning("%s is truncated or altered; recomputing %s", path, run)
        return own or self._released(path.relative_to(self.folder))

    def _released(self, name: Path) -> tuple[Result, str] | None:
        """As `_read`, of a run that the release keeps."""
        path = self.kept / f"{name}{COMPRESSED}" if self.kept else None
        if not path or not path.exists():
            return None
        try:
            found = checked(lzma.decompress(path.read_bytes()))
        except (lzma.LZMAError, EOFError):
            found = None
        if not found:
            logging.getLogger(__name__).warning("%s is truncated or altered; it is computed again", path)
        return found

    def _compute(self, missing: Mapping[str, Run], what: str) -> None:
        """Has workers compute runs and stores each as soon as it is done."""
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
        """The workers for the missing runs; their progress goes into a folder."""
        if isinstance(self.workers, str):
            from lt_lib.store.cluster import cluster_workers  # here, since Dask takes a second to import

            return cluster_workers(self.workers, progress)
        source = "".join(sorted({source_state(function) for function in {run.function for run in missing.values()}}))
        return local_workers(min(self.workers or cores(), len(missing)), source, progress)

    def _end(self, key: str, run: Run, future: "Future[Packed]") -> BaseException | None:
        """Stores the result of a run that ended; returns the error if it has none or cannot be stored."""
        if future.cancelled():
            return ConnectionError(f"lost the scheduler at {self.workers}")
        if error := future.exception():
            return error
        try:
            self._keep(key, run, *future.result())
        except OSError as error:
            return error
        return None

    def _keep(self, key: str, run: Run, payload: bytes, seconds: float, made_on: str) -> None:
        """Writes a run's file, then its line in the journal."""
        write_atomically(self._path(key, run), sealed(payload, made_on))
        line = {
            "key": key,
            "function": run.function.__name__,
            "config": run.config.model_dump(mode="json"),
            "seed": run.seed,
            "seconds": round(seconds, 3),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        journal.append(self.folder, line)


def fetch_by_name(
    fetch: Callable[[list[Run], str], list[Result]], runs: Mapping[tuple[str, int], Run], what: str
) -> dict[str, list[Result]]:
    """What a store's `fetch` returns for runs that are called (name, seed): a list of seeds per name."""
    results: dict[str, list[Result]] = {}
    for (name, _), result in zip(runs, fetch(list(runs.values()), what), strict=True):
        results.setdefault(name, []).append(result)
    return results


def sealed(payload: bytes, made_on: str) -> bytes:
    """A run's file: a line with its checksum, which covers the computer that made it too; then the packed result."""
    checksum = hashlib.sha256(payload + made_on.encode()).hexdigest()
    return f"sha256 {checksum} {made_on}\n".encode() + payload


def checked(content: bytes) -> tuple[Result, str] | None:
    """The result in a run's file and the computer that made it; None if the file is truncated or altered."""
    head, _, payload = content.partition(b"\n")
    made_on = head.decode(errors="replace").split(" ", 2)[-1]
    return (unpack(payload), made_on) if content == sealed(payload, made_on) else None
