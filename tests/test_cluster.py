"""A real Dask scheduler with worker processes on loopback: the same bytes, and what may go wrong with it."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import distributed
import numpy as np
import pytest
from dask import config as dask_config
from toy_project import LIMIT_S, journal, kept_files, losses, wait_until
from toy_runs import ToyConfig, count_threads, train_toy

from lt_lib.settings.base import ROOT, UserError
from lt_lib.store import cluster
from lt_lib.store.progress import read_progress
from lt_lib.store.run import Run
from lt_lib.store.runs import RunError, RunStore
from run_all import main

pytestmark = pytest.mark.slow


def dask(*arguments: str, library: Path = ROOT) -> subprocess.Popen:
    """A process of Dask that finds our library in a folder, the tests' runs, and too many threads."""
    paths = f"{library}{os.pathsep}{ROOT / 'tests'}"
    environment = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2"}
    command = [sys.executable, "-m", "dask", *arguments, "--no-dashboard"]
    return subprocess.Popen(command, cwd=library, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


class Cluster:
    """A scheduler, and workers as they join."""

    def __init__(self, folder: Path) -> None:
        file = folder / "scheduler.json"
        self.processes = [dask("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file))]
        wait_until(file.exists, LIMIT_S)
        self.client = distributed.Client(scheduler_file=str(file), timeout=LIMIT_S, set_as_default=False)
        self.address = self.client.scheduler.address

    def join(self, name: str, library: Path = ROOT, threads: int = 1) -> subprocess.Popen:
        """One more worker; returns once the scheduler has it."""
        count = len(self.client.nthreads())
        options = ["--name", name, "--nthreads", str(threads), "--no-nanny"]
        self.processes.append(dask("worker", self.address, *options, library=library))
        wait_until(lambda: len(self.client.nthreads()) > count, LIMIT_S)
        return self.processes[-1]

    def leave(self, worker: subprocess.Popen) -> None:
        count = len(self.client.nthreads())
        worker.kill()
        wait_until(lambda: len(self.client.nthreads()) < count, LIMIT_S)

    def busy(self) -> list[str]:
        """The addresses of the workers that have a task."""
        return [worker for worker, tasks in self.client.processing().items() if tasks]

    def end(self) -> None:
        self.client.close()
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """A cluster without workers, until `small_cluster` is asked for."""
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    yield made
    made.end()


@pytest.fixture(scope="module")
def small_cluster(scheduler):
    for name in ("one", "two"):
        scheduler.join(name)
    return scheduler


def toys(count: int, **settings) -> list[Run]:
    return [Run(train_toy, ToyConfig(**settings), seed) for seed in range(count)]


def assert_refused(project: Path, capfd, address: str, *complaints: str) -> None:
    assert main(["--profile", "smoke", "--scheduler", address], project) == 2
    out, err = capfd.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    for complaint in complaints:
        assert complaint in err
    assert not (project / "outputs").exists()


def test_a_scheduler_that_does_not_answer_is_one_line(project, capfd, monkeypatch):
    monkeypatch.setattr(cluster, "ANSWER_S", 0.5)
    assert_refused(project, capfd, "tcp://127.0.0.1:9", "run_all: no Dask scheduler answers at tcp://127.0.0.1:9 ")


def test_a_scheduler_without_workers_or_with_one_of_several_threads_is_one_line(scheduler, project, capfd, monkeypatch):
    advice = f"has no workers; start some with `dask worker {scheduler.address} --nthreads 1`"
    with monkeypatch.context() as patch:
        patch.setattr(cluster, "ANSWER_S", 3)
        assert_refused(project, capfd, scheduler.address, advice)
    wide = scheduler.join("wide", threads=2)
    assert_refused(project, capfd, scheduler.address, "has 2 threads; start it with --nthreads 1")
    scheduler.leave(wide)


def test_result_files_are_the_same_bytes_as_local_ones(small_cluster, tmp_path):
    for folder, workers in (("here", 1), ("there", small_cluster.address)):
        store = RunStore(tmp_path / folder, workers)
        start = store.fetch(toys(4, seconds=0.1), "toys")
        store.fetch([Run(train_toy, ToyConfig(), 0, {"start": start[0]})], "more toys")
    files = kept_files(tmp_path / "here")
    assert len(files) == 5
    assert kept_files(tmp_path / "there") == files


def test_a_worker_computes_with_one_thread_whatever_it_was_started_with(small_cluster, tmp_path):
    (threads,) = RunStore(tmp_path, small_cluster.address).fetch([Run(count_threads, ToyConfig(), 0)], "threads")
    assert threads == {"torch": 1, "numba": 1}


def test_run_all_sends_its_runs_to_the_cluster(small_cluster, project):
    assert main(["--profile", "smoke", "--only", "02", "--scheduler", small_cluster.address], project) == 0
    assert len(journal(project)) == 2
    alone = [train_toy(ToyConfig(size=5), seed, report=lambda fraction: None)["loss"] for seed in range(2)]
    assert losses(project, "02_encoder") == alone


def test_a_failing_run_is_named_and_the_others_are_kept(small_cluster, tmp_path):
    with pytest.raises(RunError, match=r"1 of 3 .*train_toy\(seed=0, fails=True\): ValueError: this seed"):
        RunStore(tmp_path, small_cluster.address).fetch([*toys(1, fails=True), *toys(2)], "toys")
    assert len(kept_files(tmp_path)) == 2


def test_a_worker_with_another_version_is_refused_with_both_versions(small_cluster, project, capfd, tmp_path):
    shutil.copytree(ROOT / "lt_lib", tmp_path / "other" / "lt_lib")
    with (tmp_path / "other" / "lt_lib" / "params.py").open("a") as file:
        file.write("\nEDITED = True\n")
    other = small_cluster.join("other", library=tmp_path / "other")
    theirs = small_cluster.client.run(cluster.identity)
    (address,) = (worker for worker, found in theirs.items() if found != cluster.identity())
    ours, name = cluster.identity()[cluster.OURS], cluster.OURS
    expected = f"worker {address} has {name} {theirs[address][name]}, expected {ours}; start it with this version"
    assert_refused(project, capfd, small_cluster.address, expected)
    small_cluster.leave(other)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"torch": "0.1"}, "^worker tcp://there:1 has torch 0.1, expected 2; start it with this version$"),
        ({"torch": None}, "^worker tcp://there:1 has no torch, expected 2; start it with this version$"),
    ],
)
def test_other_libraries_are_refused(change, complaint):
    ours = {"ours": "1", "torch": "2"}
    cluster.require_same(ours, dict(ours), "tcp://there:1")
    theirs = {name: version for name, version in (ours | change).items() if version}
    with pytest.raises(UserError, match=complaint):
        cluster.require_same(ours, theirs, "tcp://there:1")


def test_code_edited_after_a_process_began_is_told(monkeypatch):
    monkeypatch.setattr(cluster, "LOADED", "before")
    assert cluster.identity()[cluster.OURS].endswith(f"(code before, since edited to {cluster.code_digest()})")


def test_a_worker_that_finds_other_source_than_the_key_s_does_not_compute(small_cluster, tmp_path, monkeypatch):
    monkeypatch.setattr("lt_lib.store.run.source_digest", lambda *_, folder: "other")
    with pytest.raises(RunError, match="different source or a different layout for train_toy"):
        RunStore(tmp_path, small_cluster.address).fetch(toys(1), "toys")
    assert not kept_files(tmp_path)


# --- these two end parts of the cluster, and come last


def fetch_in_the_background(folder: Path, small_cluster: Cluster, runs: list[Run]) -> Future:
    """A fetch, once one of its runs tells that it is in the middle."""
    since = time.monotonic()
    future = ThreadPoolExecutor(1).submit(RunStore(folder, small_cluster.address).fetch, runs, "toys")
    wait_until(lambda: (now := read_progress(folder, since)) and now.fraction > now.done / now.total, LIMIT_S)
    return future


def test_a_run_whose_worker_is_killed_in_the_middle_is_computed_by_another(small_cluster, tmp_path):
    pids = small_cluster.client.run(os.getpid)
    future = fetch_in_the_background(tmp_path, small_cluster, toys(1, seconds=2))
    (first,) = small_cluster.busy()
    os.kill(pids[first], signal.SIGKILL)
    wait_until(lambda: small_cluster.busy() not in ([], [first]), LIMIT_S)
    (result,) = future.result(timeout=LIMIT_S)
    np.testing.assert_array_equal(result["weights"], np.random.default_rng(0).normal(size=(4, 3)))
    assert sum('"key"' in line for line in (tmp_path / "journal.jsonl").read_text().splitlines()) == 1


def test_a_lost_scheduler_is_named_and_finished_runs_are_kept(small_cluster, tmp_path):
    future = fetch_in_the_background(tmp_path, small_cluster, [*toys(1), *toys(3, seconds=2)])
    wait_until(lambda: len(kept_files(tmp_path)) == 1, LIMIT_S)
    small_cluster.processes[0].kill()
    with pytest.raises(RunError, match=f"3 of 4 runs failed.*lost the scheduler at {small_cluster.address}"):
        future.result(timeout=LIMIT_S)
    assert len(kept_files(tmp_path)) == 1


# --- what listens at the address, and TLS


@pytest.mark.parametrize("greets", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n"])
def test_what_is_no_scheduler_is_told_within_seconds(project, capfd, monkeypatch, greets):
    """A web server waits for a request; another says something of its own, which no Dask client understands."""
    monkeypatch.setattr(cluster, "ANSWER_S", 2)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            while True:
                try:
                    peer, _ = server.accept()
                except OSError:
                    return
                peers.append(peer)
                if greets:
                    peer.sendall(greets)

        peers: list[socket.socket] = []
        threading.Thread(target=serve, daemon=True).start()
        started = time.monotonic()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        assert_refused(project, capfd, address, f"no Dask scheduler answers at {address}")
        assert time.monotonic() - started < 20


def test_tls_without_certificates_says_where_to_name_them(project, capfd):
    assert_refused(
        project, capfd, "tls://127.0.0.1:8786", "TLS needs certificates", "DASK_DISTRIBUTED__COMM__TLS__CA_FILE"
    )


@pytest.mark.skipif(not shutil.which("openssl"), reason="needs openssl to make certificates")
def test_runs_go_over_tls_as_the_readme_says(tmp_path, monkeypatch):
    own = ["-subj", "/CN=localhost", "-keyout", "key.pem", "-out", "cert.pem", "-days", "2", "-nodes"]
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", *own], cwd=tmp_path, check=True, capture_output=True
    )
    cert, key, file = (str(tmp_path / name) for name in ("cert.pem", "key.pem", "scheduler.json"))
    secured = ["--tls-ca-file", cert, "--tls-cert", cert, "--tls-key", key]
    place = ["--protocol", "tls", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", file]
    processes = [dask("scheduler", *place, *secured)]
    try:
        wait_until(Path(file).exists, LIMIT_S)
        address = json.loads(Path(file).read_text())["address"]
        assert address.startswith("tls://")
        processes.append(dask("worker", address, "--nthreads", "1", "--no-nanny", *secured))
        names = {f"{cluster.TLS}.ca-file": cert, f"{cluster.TLS}.client.cert": cert, f"{cluster.TLS}.client.key": key}
        with dask_config.set(names):  # as the environment's DASK_DISTRIBUTED__... would
            (result,) = RunStore(tmp_path / "runs", address).fetch(toys(1), "toys")
        np.testing.assert_array_equal(result["weights"], np.random.default_rng(0).normal(size=(4, 3)))
        plain = f"tcp://{address.partition('://')[2]}"
        monkeypatch.setattr(cluster, "ANSWER_S", 3)
        with pytest.raises(UserError, match="no Dask scheduler"):
            RunStore(tmp_path / "others", plain).fetch(toys(1), "toys")
    finally:
        for process in processes:
            process.kill()
            process.wait()
