"""The run store: keys, checked files, workers, failures and progress."""

import importlib
import json
import logging
import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pydantic import computed_field
from toy_runs import ToyConfig, count_threads, lose_worker, train_toy

from lt_lib.settings.base import UserError
from lt_lib.store.files import kept_folder
from lt_lib.store.kept import keep, lightened
from lt_lib.store.manifest import computed_since, write_manifest
from lt_lib.store.progress import Reporter, read_progress, stage, write_fraction
from lt_lib.store.run import Run, bare, pack, unpack
from lt_lib.store.runs import RunError, RunStore
from lt_lib.store.sources import source_digest

SLOW = ToyConfig(seconds=0.3)


def toys(count, config=SLOW):
    return [Run(train_toy, config, seed) for seed in range(count)]


def journal_keys(folder: Path) -> list[str]:
    return [json.loads(line)["key"] for line in (folder / "journal.jsonl").read_text().splitlines() if "key" in line]


def kept_files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*/*.run")}


@pytest.fixture
def finished(tmp_path):
    """A store with one finished run, and its file."""
    store = RunStore(tmp_path, workers=1)
    (result,) = store.fetch(toys(1), "toys")
    (path,) = tmp_path.glob("train_toy/*.run")
    return store, result, path


# --- results


def test_packing_gives_back_every_kind_of_value_and_equal_bytes_for_equal_results():
    result = {
        "flags": np.array([True, False]),
        "frames": np.arange(24, dtype=np.uint8).reshape(2, 3, 4).transpose(2, 0, 1),
        "scalar_array": np.array(1.5),
        "empty": np.zeros((0, 3), np.float32),
        "loss": 0.1,
        "steps": np.int64(3),
        "text": "left",
        "curve": [1.0, float("inf")],
        "nothing": None,
    }
    packed = pack(result)
    back = unpack(packed)
    assert set(back) == set(result)
    for name, value in result.items():
        np.testing.assert_array_equal(back[name], value)
        assert getattr(back[name], "dtype", None) == getattr(value, "dtype", None) or name == "steps"
    assert pack(dict(reversed(result.items()))) == packed


@pytest.mark.parametrize("value", [np.array(["left"]), {"a": object()}])
def test_a_result_that_cannot_be_kept_is_named(value):
    with pytest.raises(TypeError, match="route"):
        pack({"route": value})


# --- keys


def test_key_follows_function_config_seed_and_the_contents_of_inputs():
    start = {"weights": np.zeros((4, 3))}
    runs = [
        Run(train_toy, ToyConfig(), 0),
        Run(train_toy, ToyConfig(), 1),
        Run(train_toy, ToyConfig(size=5), 0),
        Run(count_threads, ToyConfig(), 0),
        Run(train_toy, ToyConfig(), 0, {"start": start}),
        Run(train_toy, ToyConfig(), 0, {"start": {"weights": np.ones((4, 3))}}),
    ]
    assert len({run.key() for run in runs}) == len(runs)
    assert Run(train_toy, ToyConfig(size=4), 0, {"start": {"weights": np.zeros((4, 3))}}).key() == runs[4].key()


def test_a_run_that_starts_from_weights_left_out_has_the_key_of_one_that_starts_from_the_weights():
    start = {"weights": np.arange(12.0).reshape(4, 3), "one": np.array(2.5), "none": np.empty((0, 4)), "text": "so"}
    keys = {Run(train_toy, ToyConfig(), 0, {"start": each}).key() for each in (start, bare(start), bare(bare(start)))}
    others = (start["weights"].reshape(3, 4), start["weights"].astype(np.float32), start["weights"] + 1)
    changed = {Run(train_toy, ToyConfig(), 0, {"start": start | {"weights": other}}).key() for other in others}
    assert len(keys) == 1 and len(keys | changed) == 4
    assert unpack(pack(bare(start))) == bare(start)
    with pytest.raises(UserError, match="the release leaves these weights out"):
        np.asarray(bare(start)["weights"])


def test_key_follows_what_settings_compute_and_its_name_in_errors_does_not(tmp_path):
    path = tmp_path / "layout.yaml"

    class SceneConfig(ToyConfig):
        @computed_field
        def layout(self) -> str:
            return path.read_text()

    path.write_text("narrow")
    run = Run(train_toy, SceneConfig(), 0)
    before = run.key()
    path.write_text("wide")
    assert run.key() != before
    assert str(run) == "train_toy(seed=0)"


@pytest.mark.parametrize("library", ["torch", "numpy", "mujoco"])
def test_key_follows_library_versions(library, monkeypatch):
    before = toys(1)[0].key()
    monkeypatch.setattr("lt_lib.store.run.library_versions", lambda: {library: "0.1"})
    assert toys(1)[0].key() != before


def test_a_function_that_workers_cannot_import_is_refused():
    with pytest.raises(ValueError, match="local_train"):

        def local_train(config, seed, *, report):
            return {}

        Run(local_train, ToyConfig(), 0)


LAB = {
    "lab/__init__.py": "",
    "lab/train.py": '"""Doc."""\n'
    "from lab.deep import layer\nfrom lt_lib.settings.lab import TrainConfig\ndef train(): pass\n",
    "lab/deep/__init__.py": "WIDTH = 3\n",
    "lab/deep/layer.py": "def layer():\n    from .. import lazy\n    return 1\n",
    "lab/lazy.py": "import numpy\n",
    "lab/unrelated.py": "from lab import train\n",
    "lt_lib/__init__.py": "",
    "lt_lib/settings/lab.py": "from lt_lib.settings.base import Base\nclass TrainConfig(Base): size = 1\n",
    "lt_lib/settings/base.py": "class Base: pass\n",
    "lt_lib/settings/other.py": "class OtherConfig(Base): size = 1\n",
}


@pytest.fixture
def lab_digest(tmp_path):
    """The digest of lab.train.train after an edit: lab_digest(file, old, new)."""

    def train():
        pass

    train.__module__ = "lab.train"

    def digest(file="lab/train.py", old="", new=""):
        for name, text in LAB.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text.replace(old, new, 1) if name == file else text)
        return source_digest(train, folder=tmp_path)

    return digest


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("lab/train.py", "pass", "return 2"),
        ("lab/deep/__init__.py", "3", "4"),
        ("lab/deep/layer.py", "return 1", "return 2"),
        ("lab/lazy.py", "numpy", "scipy"),
        ("lt_lib/settings/lab.py", "size = 1", "size = 2"),
        ("lt_lib/settings/base.py", "Base: pass", "Base: size = 2"),
    ],
)
def test_digest_changes_with_code_that_is_imported(lab_digest, file, old, new):
    assert lab_digest(file, old, new) != lab_digest()


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("lab/unrelated.py", "train", "deep"),
        ("lab/train.py", "Doc.", "Another docstring."),
        ("lab/train.py", "def train(): pass", "# why\ndef train():\n    'What it does.'\n    pass"),
        ("lt_lib/settings/other.py", "size = 1", "size = 2"),
    ],
)
def test_digest_stays_with_unrelated_code_comments_and_docstrings(lab_digest, file, old, new):
    assert lab_digest(file, old, new) == lab_digest()


# --- fetching


def test_results_come_in_order_and_finished_runs_are_not_repeated(tmp_path):
    store = RunStore(tmp_path, workers=2)
    first = store.fetch(toys(2), "toys")
    again = store.fetch([*reversed(toys(3)), toys(1)[0]], "toys")
    for result, seed in [*zip(first, (0, 1), strict=True), *zip(again, (2, 1, 0, 0), strict=True)]:
        np.testing.assert_array_equal(result["weights"], np.random.default_rng(seed).normal(size=(4, 3)))
    assert sorted(journal_keys(tmp_path)) == sorted(run.key() for run in toys(3))
    assert not list(tmp_path.glob("inflight/*"))


def test_result_files_are_the_same_bytes_for_one_worker_and_two(tmp_path):
    for workers in (1, 2):
        start = RunStore(tmp_path / str(workers), workers).fetch(toys(2), "toys")
        runs = [Run(train_toy, ToyConfig(), seed, {"start": start[seed]}) for seed in range(2)]
        RunStore(tmp_path / str(workers), workers).fetch(runs, "more toys")
    files = kept_files(tmp_path / "1")
    assert len(files) == 4
    assert files == kept_files(tmp_path / "2")


def test_workers_are_kept_from_stage_to_stage_until_the_source_is_edited(tmp_path, monkeypatch):
    code = "import os\ndef train(config, seed, *, report): return {{'version': {}, 'worker': os.getpid()}}\n"
    module = tmp_path / "edited_toy.py"
    monkeypatch.syspath_prepend(tmp_path)
    store = RunStore(tmp_path / "runs", 1)

    def stage(version: int, seed: int) -> tuple[int, int]:
        module.write_text(code.format(version))
        os.utime(module, (version, version))  # the second write may fall into the first one's tick of the clock
        importlib.invalidate_caches()
        toy = importlib.import_module("edited_toy")
        (result,) = store.fetch([Run(toy.train, ToyConfig(), seed)], "edited toy")
        return result["version"], result["worker"]

    (first, one), (again, same), (edited, other) = stage(1, 0), stage(1, 1), stage(2, 2)
    assert (first, again, edited) == (1, 1, 2)
    assert one == same != other


@pytest.mark.parametrize("workers", [1, 2])
def test_a_worker_has_one_thread(tmp_path, workers):
    (threads,) = RunStore(tmp_path, workers).fetch([Run(count_threads, ToyConfig(), 0)], "threads")
    assert threads == {"torch": 1, "numba": 1}


@pytest.mark.parametrize(
    "damage", [lambda old: old[:-20], lambda old: old[:-1] + bytes([old[-1] ^ 1]), lambda old: b""]
)
def test_a_damaged_file_is_named_and_computed_again(finished, caplog, damage):
    store, result, path = finished
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    with caplog.at_level(logging.WARNING):
        (again,) = store.fetch(toys(1), "toys")
    (record,) = caplog.records
    assert str(path) in record.getMessage()
    assert "\n" not in record.getMessage()
    assert path.read_bytes() == whole
    np.testing.assert_array_equal(again["weights"], result["weights"])
    assert len(journal_keys(store.folder)) == 2


def test_a_failing_run_is_named_and_the_others_are_kept(tmp_path):
    bad = Run(train_toy, ToyConfig(size=2, fails=True), 7)
    with pytest.raises(RunError, match=r"1 of 3 .*train_toy\(seed=7, size=2, fails=True\): ValueError: this seed"):
        RunStore(tmp_path, workers=1).fetch([bad, *toys(2)], "toys")
    assert sorted(journal_keys(tmp_path)) == sorted(run.key() for run in toys(2))


def test_a_lost_worker_is_reported(tmp_path):
    with pytest.raises(RunError, match=r"lose_worker\(seed=0\): TerminatedWorkerError"):
        RunStore(tmp_path, workers=1).fetch([Run(lose_worker, ToyConfig(), 0)], "toys")


def test_an_unwritable_folder_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=f"^cannot write in the folder {tmp_path}/file/runs: .*$"):
        RunStore(tmp_path / "file" / "runs").fetch(toys(1), "toys")


# --- progress


def test_progress_counts_finished_runs_and_parts_of_those_in_flight(tmp_path):
    since = time.monotonic()
    with stage(tmp_path, "toys", total=4) as (folder, finished):
        Reporter(partial(write_fraction, folder / "one.json"))(0.9)
        finished("one")
        Reporter(partial(write_fraction, folder / "two.json"))(0.5)
        time.sleep(0.2)
        progress = read_progress(tmp_path, since)
        assert (progress.what, progress.done, progress.total) == ("toys", 1, 4)
        assert progress.fraction == pytest.approx(1.5 / 4)
        assert progress.left == pytest.approx(progress.seconds * 2.5 / 1.5)
        assert read_progress(tmp_path, since=time.monotonic()) is None
    assert read_progress(tmp_path, since) is None


def test_what_a_killed_process_left_is_removed(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    left = tmp_path / "inflight" / str(process.pid)
    left.mkdir(parents=True)
    with stage(tmp_path, "toys", total=1) as (folder, _):
        assert list(tmp_path.glob("inflight/*")) == [folder]


def test_a_reporter_tells_at_most_twice_a_second():
    told = []
    report = Reporter(told.append)
    for fraction in (0.1, 0.2, 0.3):
        report(fraction)
    assert told == [0.1]


# --- what a release keeps


@pytest.fixture
def released(tmp_path):
    """Folders of outputs, of the two finished runs that they used beside a third one, and of those kept."""
    outputs, runs, kept = (tmp_path / name for name in ("outputs", "runs", "kept"))
    (tmp_path / "requirements.txt").write_text("numpy==1.0\n")
    store = RunStore(runs, 1, None)
    store.fetch(toys(1), "toys")
    store.fetch([Run(train_toy, ToyConfig(size=30_000), 0)], "cheap for its size")
    used = computed_since(runs, 0, "")
    store.fetch(toys(3)[2:], "not used")
    write_manifest(
        outputs / "manifest.json", tmp_path, "full", {"02_encoder": {"status": "ok", "seconds": 9.0, **used}}
    )
    return outputs, runs, kept


def test_a_release_keeps_the_runs_that_were_used_and_are_worth_their_bytes_and_nothing_from_before(released):
    outputs, runs, kept = released
    old = kept / "train_toy" / "old.run.xz"
    old.parent.mkdir(parents=True)
    old.write_bytes(b"of an earlier release")
    size = keep(outputs, runs, kept)
    (path,) = kept.glob("*/*")
    assert path.name == f"{toys(1)[0].key()}.run.xz" and path.stat().st_size == size


def test_notebooks_opened_by_hand_read_the_runs_of_a_release_and_recompute_damaged_ones(released, tmp_path, caplog):
    outputs, runs, kept = released
    keep(outputs, runs, kept)
    (expected,) = RunStore(runs, 1, None).fetch(toys(1), "toys")
    (result,) = RunStore(tmp_path / "fresh", 1, kept).fetch(toys(1), "toys")
    assert pack(result) == pack(expected) and not journal_keys(tmp_path / "fresh")
    (path,) = kept.glob("*/*")
    for damage in (path.read_bytes()[:-9], b"no archive"):
        path.write_bytes(damage)
        (result,) = RunStore(tmp_path / f"anew {len(damage)}", 1, kept).fetch(toys(1), "toys")
        assert pack(result) == pack(expected) and len(journal_keys(tmp_path / f"anew {len(damage)}")) == 1
    assert caplog.text.count("truncated or altered") == 2


@pytest.mark.parametrize(
    ("function", "seed", "left_out"),
    [
        ("roll_navigator", 1, []),
        ("train_head", 0, []),
        ("train_head", 1, ["head.0.weight"]),
        ("train_navigator", 0, ["head.0.weight"]),
    ],
)
def test_a_release_leaves_out_the_weights_that_only_runs_start_from(function, seed, left_out):
    result = {"head.0.weight": np.ones(3), "head.0.bias": np.ones(3), "path": np.ones(3), "loss": 1.0}
    light = lightened(result, function, seed)
    assert [name for name, value in light.items() if value is not result[name]] == left_out
    assert light.keys() == result.keys() and pack(bare(light)) == pack(bare(result))


def test_run_all_does_not_see_what_a_release_keeps(tmp_path, monkeypatch):
    monkeypatch.delenv("LT_RUNS", raising=False)
    assert kept_folder(tmp_path) == tmp_path / "outputs" / "kept"
    monkeypatch.setenv("LT_RUNS", str(tmp_path))
    assert RunStore(tmp_path).kept is None


def test_keeping_names_a_used_run_that_is_gone(released):
    outputs, runs, kept = released
    (runs / "train_toy" / f"{toys(1)[0].key()}.run").unlink()
    with pytest.raises(UserError, match="lacks 1 runs that .*outputs used .train_toy/"):
        keep(outputs, runs, kept)
    assert not kept.exists()


def test_keeping_names_a_used_run_that_is_damaged(released):
    outputs, runs, kept = released
    path = runs / "train_toy" / f"{toys(1)[0].key()}.run"
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(UserError, match=f"{path} is truncated or altered; run_all.py makes it again"):
        keep(outputs, runs, kept)


def test_an_execution_that_finds_runs_finished_keeps_the_sitting_that_computed_them(released):
    outputs, runs, _ = released

    def entry(seconds, stages, used):
        made = {"status": "ok", "seconds": seconds, "stages": stages, "computers": [], "runs": used}
        write_manifest(outputs / "manifest.json", outputs.parent, "full", {"02_encoder": made})
        return json.loads((outputs / "manifest.json").read_text())["notebooks"]["02_encoder"]

    used = computed_since(runs, 0, "")["runs"][:2]
    computed = {"train_toy": {"runs": 2, "seconds": 80.0}}
    assert entry(90.0, computed, used)["sitting"] == {"commit": None, "seconds": 90.0, "stages": computed}
    again = entry(3.0, {}, used)
    assert again["seconds"] == 3.0 and again["sitting"]["seconds"] == 90.0
    part = entry(40.0, {"train_toy": {"runs": 1, "seconds": 39.0}}, used)
    assert part["seconds"] == 40.0 and part["sitting"]["seconds"] == 90.0
    assert entry(60.0, computed, used)["sitting"]["seconds"] == 60.0, "computed from nothing again"
    assert entry(2.0, {}, used[:1])["sitting"]["seconds"] == 2.0, "other runs, from who knows where"
    assert entry(8.0, {}, [])["sitting"]["seconds"] == 8.0
    assert entry(7.0, {}, [])["sitting"]["seconds"] == 7.0, "what uses no run is a sitting of its own"
