"""What may go wrong around a computation: kills, full and read-only disks, damage, company, edits.

Nothing finished is lost, and nothing wrong is believed.
"""

import contextlib
import json
import logging
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from toy_project import COMPUTE, LIMIT_S, PARAMETERS, WRITE, journal, kept_files, losses, smoke, write_notebook
from toy_runs import ToyConfig, train_toy

from lt_lib.settings.base import UserError
from lt_lib.store.files import claimed
from lt_lib.store.manifest import write_manifest
from lt_lib.store.progress import Reporter, stage, write_fraction
from lt_lib.store.run import Run
from lt_lib.store.runs import RunError, RunStore
from run_all import code_digest

pytestmark = pytest.mark.slow


def toys(count: int, **settings) -> list[Run]:
    return [Run(train_toy, ToyConfig(**settings), seed) for seed in range(count)]


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 256 KiB of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting a disk of its own needs root")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def remount(folder: Path, option: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{option}", str(folder)], check=True)


def fill(folder: Path) -> None:
    """Leaves no byte free."""
    with (folder / "filler").open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(512))


# --- killed


def kill_after(process: subprocess.Popen, seconds: float) -> None:
    """SIGKILL, unless it ends before; returns when its kernel and workers are gone too."""
    try:
        process.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        below = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        process.wait()
        _, alive = psutil.wait_procs(below, timeout=LIMIT_S)
        assert not alive


def cells(root: Path) -> subprocess.Popen:
    """The cells of a toy notebook in a process of their own, which starts sooner than a kernel."""
    (root / "outputs" / "smoke").mkdir(parents=True, exist_ok=True)
    parameters = PARAMETERS.replace("toy = {}", "toy = {'seconds': 0.1}").replace("count = 2", "count = 8")
    code = "\n".join((parameters, COMPUTE, WRITE.replace("NAME", "02_encoder")))
    return subprocess.Popen([sys.executable, "-c", code.replace("workers = 0", "workers = 1")], cwd=root)


def test_killed_at_ten_random_moments_it_ends_with_what_an_undisturbed_one_gives(project, tmp_path):
    undisturbed = tmp_path / "undisturbed"
    began = time.monotonic()
    assert cells(undisturbed).wait(timeout=LIMIT_S) == 0
    whole = time.monotonic() - began
    moments, runs = random.Random(0), project / "outputs" / "runs"
    for _ in range(10):
        before = kept_files(runs)
        kill_after(cells(project), moments.uniform(0, whole))
        assert before.items() <= kept_files(runs).items()
    assert cells(project).wait(timeout=LIMIT_S) == 0
    assert losses(project, "02_encoder") == losses(undisturbed, "02_encoder")
    assert kept_files(runs) == kept_files(undisturbed / "outputs" / "runs")
    keys = [line["key"] for line in journal(project)]
    assert len(keys) == len(set(keys)) == 8  # no finished run was repeated


# --- full and read-only disks


def test_on_a_disk_that_fills_up_finished_runs_are_kept_and_the_others_follow_once_there_is_room(small_disk):
    store, runs = RunStore(small_disk, workers=1), toys(4, size=4_000)  # 94 KiB each
    with pytest.raises(RunError, match="2 of 4 runs failed.*No space left on device"):
        store.fetch(runs, "toys")
    before = kept_files(small_disk)
    assert len(before) == 2
    assert not list(small_disk.glob("train_toy/.*"))
    remount(small_disk, "size=4m")
    assert len(store.fetch(runs, "toys")) == 4
    after = kept_files(small_disk)
    assert len(after) == 4 and before.items() < after.items()
    lines = map(json.loads, (small_disk / "journal.jsonl").open())
    keys = [line["key"] for line in lines if "key" in line]
    assert len(keys) == len(set(keys)) == 4  # no finished run was repeated


def test_a_run_goes_on_where_its_progress_cannot_be_written(small_disk):
    with stage(small_disk, "toys", total=1) as (folder, finished):
        fill(small_disk)
        Reporter(lambda fraction: write_fraction(folder / "one.json", fraction))(0.5)
        finished("one")


def refused(capfd, project: Path, outputs: Path) -> str:
    """The one line in which run_all refuses an outputs folder before any computing."""
    assert smoke(project, "--outputs", str(outputs)) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.count("\n") == 1
    assert not journal(project)
    return err


def test_a_full_or_read_only_outputs_folder_is_refused_before_computing(project, small_disk, capfd):
    fill(small_disk)
    assert f"cannot write in the folder {small_disk}: No space left on device" in refused(capfd, project, small_disk)
    (small_disk / "filler").unlink()
    remount(small_disk, "ro")
    assert f"cannot write in the folder {small_disk}: Read-only file system" in refused(capfd, project, small_disk)


def test_an_outputs_disk_that_fills_up_ends_in_one_line_and_finished_runs_are_kept(project, small_disk, capfd):
    cells = "import contextlib", "with contextlib.suppress(OSError): Path(outputs, 'filler').write_bytes(bytes(10**6))"
    write_notebook(project, "02_encoder", COMPUTE, *cells, WRITE)
    assert smoke(project, "--only", "02", "--outputs", str(small_disk)) == 1
    captured = capfd.readouterr()
    assert "No space left on device" in captured.out + captured.err
    assert "Traceback" not in captured.out + captured.err
    assert len(journal(project)) == 2
    remount(small_disk, "size=8m")
    write_notebook(project, "02_encoder", COMPUTE, WRITE)
    assert smoke(project, "--only", "02", "--outputs", str(small_disk)) == 0
    assert len(journal(project)) == 2


# --- damage


def test_no_truncated_or_flipped_result_is_believed(tmp_path, caplog):
    store, runs, chance = RunStore(tmp_path, workers=1), toys(40), random.Random(0)
    results = store.fetch(runs, "toys")
    whole = kept_files(tmp_path)
    for number, path in enumerate(sorted(tmp_path.glob("train_toy/*.run"))):
        content = bytearray(path.read_bytes())
        if number % 2:
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        path.write_bytes(content if number % 2 else content[: chance.randrange(len(content))])
    with caplog.at_level(logging.WARNING):
        again = store.fetch(runs, "toys")
    assert len(caplog.records) == 40
    assert [result["loss"] for result in again] == [result["loss"] for result in results]
    assert kept_files(tmp_path) == whole


@pytest.mark.parametrize("damage", ["{", "[]", "{}", '{"notebooks": 3}'])
def test_a_damaged_manifest_is_named_and_written_anew(project, caplog, damage):
    path = project / "manifest.json"
    path.write_text(damage)
    write_manifest(path, project, "smoke", {"02_encoder": {"status": "ok", "seconds": 1.0}})
    assert f"{path} is damaged" in caplog.text
    assert list(json.loads(path.read_text())["notebooks"]) == ["02_encoder"]


# --- company


def test_a_second_run_all_on_one_outputs_folder_is_refused_by_the_first_one_s_number(project, capfd):
    outputs = project / "outputs" / "smoke"
    outputs.mkdir(parents=True)
    with claimed(outputs):
        assert f"run_all: process {os.getpid()} is already writing in {outputs}" in refused(capfd, project, outputs)


def test_a_killed_process_claims_nothing(tmp_path):
    hold = """import pathlib, sys, time
from lt_lib.store.files import claimed
with claimed(pathlib.Path(sys.argv[1])):
    print(1, flush=True)
    time.sleep(60)"""
    other = subprocess.Popen([sys.executable, "-c", hold, str(tmp_path)], stdout=subprocess.PIPE)
    other.stdout.readline()
    with pytest.raises(UserError, match=f"^process {other.pid} is already writing"), claimed(tmp_path):
        pass
    other.send_signal(signal.SIGKILL)
    other.wait()
    with claimed(tmp_path):
        pass


# --- edits

EDIT = """source = Path("notebooks/NAME.ipynb")
source.write_text(source.read_text().replace("range(count)", "range(1)"))"""


def test_a_notebook_edited_while_it_runs_has_failed_and_the_next_time_the_new_one_runs(project, capfd):
    write_notebook(project, "02_encoder", COMPUTE, WRITE, EDIT)
    assert smoke(project, "--only", "02") == 1
    complaint = "notebooks/02_encoder.ipynb was edited during the run; the same command executes the new one"
    assert complaint in capfd.readouterr().out
    write_notebook(project, "02_encoder", COMPUTE.replace("range(count)", "range(1)"), WRITE)
    assert smoke(project, "--only", "02") == 0
    assert len(losses(project, "02_encoder")) == 1
    assert len(journal(project)) == 2


def test_a_notebook_s_prose_and_outputs_may_change_while_it_runs(project):
    path = project / "notebooks" / "02_encoder.ipynb"
    before = code_digest(project, "02_encoder")
    notebook = json.loads(path.read_text())
    notebook["cells"].append({"cell_type": "markdown", "metadata": {}, "source": "More words."})
    notebook["cells"][1]["outputs"] = [{"output_type": "stream", "name": "stdout", "text": "1"}]
    path.write_text(json.dumps(notebook))
    assert code_digest(project, "02_encoder") == before
    notebook["cells"][1]["source"] += "\nresults = []"
    path.write_text(json.dumps(notebook))
    assert code_digest(project, "02_encoder") != before
