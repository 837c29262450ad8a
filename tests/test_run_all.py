"""run_all.py from its command line, on a small project of its own: bad input, failures, kill and resume."""

import json
import signal
import subprocess
from pathlib import Path

import nbformat
import psutil
import pytest
from pydantic import TypeAdapter, ValidationError
from toy_project import COMPUTE, LIMIT_S, RAISE, WRITE, journal, losses, smoke, start, wait_until, write_notebook
from toy_runs import ToyConfig, train_toy

from lt_lib.settings import profiles
from lt_lib.settings.base import Settings, UserError
from lt_lib.settings.profiles import explain, load_profile
from lt_lib.store import journal as journal_file
from lt_lib.store.manifest import computed_since
from lt_lib.store.progress import Progress
from run_all import choose, clock, describe, main

pytestmark = pytest.mark.slow

# --- bad input


@pytest.mark.parametrize(
    ("yaml", "complaint"),
    [
        ("04_pixel: {}", "smoke.yaml: unknown notebook '04_pixel'; known: 02_encoder, 03_gridworld"),
        ("shared: {seed: 2}", "smoke.yaml: shared: no notebook declares 'seed'; known: content, "),
        ("02_encoder: {seed: 2}", "smoke.yaml: 02_encoder: unknown parameter 'seed'; known: content, "),
        ("02_encoder: {count: '2'}", "smoke.yaml: 02_encoder: count: expected int such as 2, got '2'"),
        ("02_encoder: {count: true}", "smoke.yaml: 02_encoder: count: expected int such as 2, got True"),
        ("02_encoder: {count: 2.0}", "smoke.yaml: 02_encoder: count: expected int such as 2, got 2.0"),
        ("shared: {share: 1:30}", "smoke.yaml: 02_encoder: share: expected float such as 0.5, got '1:30'"),
        ("02_encoder: {content: 3}", "smoke.yaml: 02_encoder: content: expected str such as 'latent', got 3"),
        (
            "02_encoder: {sizes: [1, a]}",
            "smoke.yaml: 02_encoder: sizes: expected list such as [1, 2], got [1, 'a']",
        ),
        ("02_encoder: {toy: {size: 0}}", "smoke.yaml: 02_encoder: toy.size: must be greater than 0, got 0"),
        (
            "02_encoder: {toy: {sizes: 1}}",
            "smoke.yaml: 02_encoder: toy.sizes: unknown parameter; toy has fails, seconds, size",
        ),
        (
            "02_encoder: {toy: {size: '4'}}",
            "smoke.yaml: 02_encoder: toy.size: must be a valid integer, got '4'",
        ),
        ("02_encoder: 3", "smoke.yaml: 02_encoder: expected its parameters "),
        ("- 3", "smoke.yaml: expected sections such as 'shared:', got [3]"),
        ("02_encoder: {toy: [", "smoke.yaml: line 2: not valid YAML: "),
        ("02_encoder: {}\n02_encoder: {count: 3}", "smoke.yaml: line 2: not valid YAML: '02_encoder' is given twice"),
    ],
)
def test_a_bad_profile_is_one_line_and_nothing_is_computed(project, capfd, yaml, complaint):
    (project / "params" / "smoke.yaml").write_text(yaml)
    assert_refused(project, capfd, ["--profile", "smoke"], complaint)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--profile", "tiny"], "unknown profile 'tiny'; known: smoke"),
        (["--profile", "claims"], "unknown profile 'claims'; known: smoke"),
        (["--profile", "../params/smoke"], "unknown profile '../params/smoke'; known: smoke"),
        (
            ["--profile", "smoke", "--only", "pixels"],
            "argument --only: unknown notebook 'pixels'; known: 02_encoder",
        ),
        (["--profile", "smoke", "--workers", "-1"], "argument --workers: expected 0 or more, got -1"),
        (["--profile", "smoke", "--workers", "two"], "argument --workers: invalid int value: 'two'"),
        (
            ["--profile", "smoke", "--workers", "2", "--scheduler", "tcp://localhost:8786"],
            "argument --scheduler: the cluster provides the workers; leave --workers out",
        ),
        (
            ["--profile", "smoke", "--scheduler", "localhost"],
            "expected a scheduler's address such as tcp://127.0.0.1:8786, got 'localhost'",
        ),
        (
            ["--profile", "smoke", "--beyond", "--only", "02"],
            "argument --beyond: --only names notebooks of either kind",
        ),
        (["--profile", "smoke", "--fast"], "unrecognized arguments: --fast"),
        (["--profile", "smoke", "--outputs", "requirements.txt/out"], "cannot write in the folder "),
    ],
)
def test_a_bad_option_is_one_line_and_nothing_is_computed(project, capfd, monkeypatch, arguments, complaint):
    monkeypatch.chdir(project)
    assert_refused(project, capfd, arguments, complaint)


@pytest.mark.parametrize(
    ("parameters", "complaint"),
    [
        (
            "count = 2\ntoy = {}",
            "02_encoder.ipynb: its parameters cell must declare outputs, profile, workers",
        ),
        ("count = 1 + 1", "02_encoder.ipynb: its parameters cell may hold only name = literal"),
        ("import os", "02_encoder.ipynb: its parameters cell may hold only name = literal"),
    ],
)
def test_a_bad_parameters_cell_is_one_line(project, capfd, parameters, complaint):
    write_notebook(project, "02_encoder", COMPUTE, WRITE, parameters=parameters)
    assert_refused(project, capfd, ["--profile", "smoke"], complaint)


def test_a_notebook_without_a_parameters_cell_is_one_line(project, capfd):
    nbformat.write(nbformat.v4.new_notebook(), project / "notebooks" / "02_encoder.ipynb")
    complaint = "02_encoder.ipynb: expected exactly one cell tagged 'parameters', found 0"
    assert_refused(project, capfd, ["--profile", "smoke"], complaint)


def assert_refused(root: Path, capfd, arguments: list[str], complaint: str) -> None:
    results = root / "outputs" / "smoke" / "results" / "02_encoder.json"
    results.parent.mkdir(parents=True)
    results.write_text("earlier")
    before = sorted(root.rglob("*"))
    assert main(arguments, root) == 2
    out, err = capfd.readouterr()
    assert err.startswith(f"run_all: {complaint}")
    assert (out, err.count("\n")) == ("", 1)
    assert sorted(root.rglob("*")) == before
    assert results.read_text() == "earlier"


def test_a_profile_gives_shared_values_where_declared_and_the_notebooks_own_over_them(project):
    write_notebook(project, "04_pixels", parameters="share = 0.5\nother = 1")
    (project / "params" / "smoke.yaml").write_text("shared: {count: 3, share: 1}\n03_gridworld: {count: 4}\n")
    assert load_profile("smoke", project) == {
        "02_encoder": {"count": 3, "share": 1},
        "03_gridworld": {"count": 4, "share": 1},
        "04_pixels": {"share": 1},
    }


def test_a_dict_without_settings_is_refused(project, monkeypatch):
    monkeypatch.delitem(profiles.SECTIONS, "toy")
    with pytest.raises(UserError, match="02_encoder: toy: SECTIONS has no settings for it"):
        load_profile("smoke", project)


def test_settings_are_strict_frozen_and_take_lists_for_tuples():
    class Nested(Settings):
        corners: tuple[tuple[float, float], ...] = ()

    config = Nested(corners=[[0, 1], [2, 3.5]])
    assert config.corners == ((0, 1), (2, 3.5))
    assert hash(config) == hash(Nested(corners=((0, 1), (2, 3.5))))
    for bad in ({"corners": [["0", 1]]}, {"corners": [[float("nan"), 1]]}, {"corner": []}):
        with pytest.raises(ValidationError):
            Nested(**bad)
    with pytest.raises(ValidationError):
        config.corners = ()


def test_the_error_of_a_deep_setting_names_its_place():
    with pytest.raises(ValidationError) as caught:
        TypeAdapter(dict[str, list[int]]).validate_python({"a": [1, "2"]}, strict=True)
    assert explain(caught.value, "toy", dict) == "toy.a.1: must be a valid integer, got '2'"


def test_an_unknown_setting_in_a_dict_or_list_of_settings_is_named_with_those_there_are():
    class Shelf(Settings):
        toys: dict[str, ToyConfig]
        row: tuple[ToyConfig, ...] = ()

    for bad, place in (({"toys": {"red": {"sise": 1}}}, "toys.red"), ({"toys": {}, "row": [{"sise": 1}]}, "row.0")):
        with pytest.raises(ValidationError) as caught:
            Shelf(**bad)
        complaint = f"shelf.{place}.sise: unknown parameter; shelf.{place} has fails, seconds, size"
        assert explain(caught.value, "shelf", Shelf) == complaint


# --- executing


def test_only_takes_numbers_and_names():
    names = ["02_encoder", "04_pixels", "07_corruption"]
    assert choose(["corruption", "2"], names) == ["02_encoder", "07_corruption"]
    assert choose(["04_pixels", "04"], names) == ["04_pixels"]


def test_list_names_the_notebooks(project, capfd):
    assert main(["--list"], project) == 0
    assert capfd.readouterr().out == "02_encoder\n03_gridworld\n"


@pytest.mark.parametrize(("seconds", "shown"), [(5.4, "0:05"), (125, "2:05"), (3725, "1:02:05")])
def test_clock(seconds, shown):
    assert clock(seconds) == shown


@pytest.mark.parametrize(
    ("progress", "line"),
    [
        (None, "1:00"),
        (Progress("route heads", 0, 35, 0.0, 4.0, None), "1:00  route heads 0/35 (0%)"),
        (
            Progress("route heads", 12, 35, 0.34, 60.0, 130.0),
            "1:00  route heads 12/35 (34%), about 2:10 left",
        ),
    ],
)
def test_the_live_line_tells_runs_and_time_left(progress, line):
    assert describe(progress, 60.0) == line


def test_a_good_run_leaves_notebooks_results_logs_and_a_manifest(project, capfd):
    assert smoke(project) == 0
    outputs = project / "outputs" / "smoke"
    manifest = json.loads((outputs / "manifest.json").read_text())
    for name in ("02_encoder", "03_gridworld"):
        assert len(losses(project, name)) == 2
        assert (outputs / "logs" / f"{name}.log").exists()
        assert str(project) not in (outputs / "notebooks" / f"{name}.ipynb").read_text()
        assert manifest["notebooks"][name]["status"] == "ok"
        assert manifest["notebooks"][name]["seconds"] > 0
        assert manifest["notebooks"][name]["stages"]["train_toy"]["runs"] == 2
    assert manifest["profile"] == "smoke"
    assert set(manifest["versions"]) == {"python", "numpy"}
    assert manifest["machine"]["cores"] >= 1
    out = capfd.readouterr().out.splitlines()
    assert [line.split()[:2] for line in out if "toys" not in line][:2] == [
        ["02_encoder", "ok"],
        ["03_gridworld", "ok"],
    ]


def test_a_scoreboard_is_summed_up_in_the_last_line(project, capfd):
    table = r'Path("outputs/smoke/headline.md").write_text("| a |\n\nOf 3 claims: 2 reproduced, 1 not run.\n")'
    text = 'Path("outputs/smoke/scoreboard.csv").write_text("id,notebook\\n")'
    write_notebook(project, "09_scoreboard", "results = []\nimport json\nfrom pathlib import Path", table, text, WRITE)
    assert smoke(project, "--only", "09") == 0
    report = project / "outputs" / "smoke" / "report"
    assert "Profile smoke" in (report / "index.html").read_text() and (report / "notebooks/09_scoreboard.html").exists()
    assert capfd.readouterr().out.splitlines()[-1] == "scoreboard: Of 3 claims: 2 reproduced, 1 not run."


def test_what_is_beyond_the_paper_runs_on_demand_alone(project, capfd):
    write_notebook(project, "11_controls", COMPUTE, WRITE)
    assert smoke(project) == 0
    manifest = project / "outputs" / "smoke" / "manifest.json"
    assert "11_controls" not in json.loads(manifest.read_text())["notebooks"]
    before = {path: path.stat().st_mtime_ns for path in (project / "outputs/smoke/results").iterdir()}
    assert smoke(project, "--beyond") == 0
    assert json.loads(manifest.read_text())["notebooks"]["11_controls"]["status"] == "ok"
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())


def test_a_failed_notebook_is_named_with_cell_and_log_and_others_still_run(project, capfd):
    for name, cells in {
        "02_encoder": [COMPUTE, RAISE],
        "04_pixels": [COMPUTE, WRITE],
        "07_corruption": [],
    }.items():
        write_notebook(project, name, *cells)
    write_notebook(project, "06_z_study", COMPUTE, "raise SystemExit(0)", WRITE)
    write_notebook(
        project, "08_hardware_decode", "results = [{'loss': 1}]\nimport json\nfrom pathlib import Path", WRITE
    )
    stale = project / "outputs" / "smoke" / "results" / "06_z_study.json"
    stale.parent.mkdir(parents=True)
    stale.write_text("[]")
    assert smoke(project) == 1
    lines = {line.split()[0]: line for line in capfd.readouterr().out.splitlines() if "toys" not in line}
    assert "FAILED" in lines["02_encoder"]
    assert lines["02_encoder"].endswith("cell 3: ValueError: the gate (log: outputs/smoke/logs/02_encoder.log)")
    assert "ValueError: the gate" in (project / "outputs" / "smoke" / "logs" / "02_encoder.log").read_text()
    assert "ended without writing outputs/smoke/results/06_z_study.json" in lines["06_z_study"]
    assert "skipped" in lines["04_pixels"]
    assert lines["04_pixels"].endswith("needs 02_encoder")
    assert lines["07_corruption"].endswith("needs 03_gridworld")
    assert "ok" in lines["08_hardware_decode"]
    assert losses(project, "08_hardware_decode") == [1]


def test_a_lost_kernel_is_a_failed_notebook_whose_finished_runs_are_kept(project, capfd):
    write_notebook(project, "02_encoder", COMPUTE, "import os\nos._exit(9)", WRITE)
    assert smoke(project, "--only", "encoder") == 1
    assert "FAILED" in capfd.readouterr().out
    assert len(journal(project)) == 2
    write_notebook(project, "02_encoder", COMPUTE, WRITE)
    assert smoke(project, "--only", "encoder") == 0
    assert len(journal(project)) == 2


def test_a_second_run_of_one_notebook_keeps_the_others_in_the_manifest_and_writes_where_told(project, tmp_path):
    for only in ("02", "gridworld"):
        assert smoke(project, "--only", only, "--outputs", str(tmp_path / "elsewhere")) == 0
    manifest = json.loads((tmp_path / "elsewhere" / "manifest.json").read_text())
    assert list(manifest["notebooks"]) == ["02_encoder", "03_gridworld"]
    assert not (project / "outputs" / "smoke").exists()


# --- killing


def end_in_the_middle(root: Path, how: signal.Signals) -> subprocess.Popen:
    """Sends a signal once one run is kept and another in flight; returns when kernel and workers are gone."""
    process = start(root)
    wait_until(lambda: len(journal(root)) == 1, seconds=LIMIT_S)
    below = psutil.Process(process.pid).children(recursive=True)
    assert len(below) >= 2, "expected a kernel and a worker"
    process.send_signal(how)
    process.wait(timeout=LIMIT_S)
    _, alive = psutil.wait_procs(below, timeout=LIMIT_S)
    assert not alive
    return process


def test_killed_in_the_middle_it_goes_on_without_repeating_a_finished_run(project):
    assert end_in_the_middle(project, signal.SIGKILL).returncode == -signal.SIGKILL
    kept = len(journal(project))
    assert kept < 3
    assert start(project).wait(timeout=LIMIT_S) == 0
    assert len(journal(project)) == 3
    assert sorted(line["seed"] for line in journal(project)) == [0, 1, 2]
    undisturbed = [train_toy(ToyConfig(), seed, report=lambda fraction: None)["loss"] for seed in range(3)]
    assert losses(project, "02_encoder") == undisturbed


@pytest.mark.parametrize(
    ("how", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)], ids=["INT", "TERM", "HUP"]
)
def test_interrupted_it_says_so_and_leaves_nothing_running(project, how, status):
    process = end_in_the_middle(project, how)
    assert process.returncode == status
    (line,) = process.stderr.read().splitlines()
    assert line.startswith("run_all: interrupted; finished runs are kept")


def test_stages_are_the_runs_that_the_journal_gained_for_whoever_asks(tmp_path, monkeypatch, caplog):
    assert computed_since(tmp_path, 0, "us") == {"stages": {}, "computers": [], "runs": []}
    monkeypatch.setenv(journal_file.ASKED_BY, "us")
    journal_file.append(tmp_path, {"function": "train", "seconds": 1.2})
    before = journal_file.length(tmp_path)
    journal_file.append(tmp_path, {"function": "roll", "seconds": 2.0})
    monkeypatch.setenv(journal_file.ASKED_BY, "another run_all.py on the same store")
    journal_file.append(tmp_path, {"function": "train_point_mass", "seconds": 9.0})
    monkeypatch.setenv(journal_file.ASKED_BY, "us")
    with (tmp_path / journal_file.JOURNAL).open("a") as file:
        file.write('{"function": "train", "sec')  # the disk was full
    journal_file.append(tmp_path, {"function": "train", "seconds": 3.0})
    journal_file.append(
        tmp_path, {"fetched": "heads", "computers": ["AMD EPYC", "Intel Xeon"], "runs": ["train/b", "train/a"]}
    )
    made = computed_since(tmp_path, before, "us")
    assert made["stages"] == {"roll": {"runs": 1, "seconds": 2.0}, "train": {"runs": 1, "seconds": 3.0}}
    assert made["computers"] == ["AMD EPYC", "Intel Xeon"] and made["runs"] == ["train/a", "train/b"]
    assert computed_since(tmp_path, 0, "us")["stages"]["train"] == {"runs": 2, "seconds": 4.2}
    assert "has a line that was cut short; it is skipped" in caplog.text
