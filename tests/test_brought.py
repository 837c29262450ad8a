"""What people bring: edited constants, copied notebooks, odd paths and yaml, foreign repositories, planted files."""

import base64
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import matplotlib
import nbformat
import numpy as np
import pandas as pd
import pytest
from PIL import Image as Picture
from toy_project import COMPUTE, WRITE, smoke, write_notebook
from toy_runs import ToyConfig, train_toy

from lt_lib.envs.layout import load_layout
from lt_lib.hardware.registration import read_gates
from lt_lib.learnability.judgements import keep_curves
from lt_lib.learnability.predictor import CURVES, Curve, load_curve
from lt_lib.perception.weights import load_frozen, save_frozen
from lt_lib.report.claims import Findings, load_claims
from lt_lib.report.inferred import load_inferred
from lt_lib.report.scoreboard import COLUMNS, read_findings
from lt_lib.report.site import main as report, write_report
from lt_lib.settings.base import LAYOUTS, ROOT, UserError
from lt_lib.settings.profiles import SECTIONS, load_profile, notebook_defaults, notebook_names
from lt_lib.settings.strict_yaml import read_yaml
from lt_lib.store import computer
from lt_lib.store.files import writable_folder
from lt_lib.store.local import cores
from lt_lib.store.manifest import git_state
from lt_lib.store.run import Run
from lt_lib.store.runs import RunStore
from lt_lib.store.sources import source_digest

# --- compiled code and the constants that are frozen into it
COMPILED = {  # a module with compiled loops: a module whose constant they read, and that constant
    "lt_lib.gridworld.walks": ("lt_lib/gridworld/map.py", "HORIZON = 100"),
    "lt_lib.gridworld.table_ppo": ("lt_lib/ppo.py", "MAX_GRADIENT_NORM = 0.5"),
    "lt_lib.envs.raycast": ("lt_lib/envs/materials.py", '"sky"'),
}


@pytest.fixture(scope="module")
def checkout(tmp_path_factory) -> Path:
    return Path(shutil.copytree(ROOT / "lt_lib", tmp_path_factory.mktemp("edited") / "lt_lib")).parent


@pytest.mark.parametrize("module", COMPILED)
def test_an_edited_constant_of_another_file_is_compiled_anew(checkout, module):
    file, constant = COMPILED[module]
    path = checkout / file
    text = path.read_text()
    assert constant in text
    function = next(iter_functions(module))

    def digest() -> str:
        return source_digest(function, folder=checkout)

    before = digest()
    path.write_text(text.replace(constant, constant.replace("0", "1").replace("sky", "sky2")))
    os.utime(path, ns=(1, path.stat().st_mtime_ns + 1_000_000))
    assert digest() != before
    path.write_text(text)
    os.utime(path, ns=(1, path.stat().st_mtime_ns + 2_000_000))
    assert digest() == before


def iter_functions(name: str):
    module = __import__(name, fromlist=["_"])
    for value in vars(module).values():
        if hasattr(value, "py_func"):
            yield value.py_func


HORIZON_OF_WALKS = """
import sys
import numpy as np
from lt_lib.envs.layout import load_layout
from lt_lib.gridworld.map import HORIZON, Grid
from lt_lib.gridworld.walks import first_states, walk
grid, rng = Grid(load_layout("grid")), np.random.default_rng(0)
stay = np.zeros((1 + len(grid.posts), len(grid.cells), 2, 5)); stay[..., 0] = 1  # nobody moves, so all time out
walks, _ = walk(grid, stay, first_states(grid, 4, rng), 400, rng, 1)
print(HORIZON, walks.length[walks.ended].max())
"""


@pytest.mark.slow
def test_compiled_walks_time_out_at_the_edited_horizon(tmp_path):
    shutil.copytree(ROOT / "lt_lib", tmp_path / "lt_lib", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "params", tmp_path / "params")
    path = tmp_path / "lt_lib" / "gridworld" / "map.py"
    seen = []
    for horizon in (100, 37):
        path.write_text(path.read_text().replace("HORIZON = 100", f"HORIZON = {horizon}"))
        command = [sys.executable, "-c", HORIZON_OF_WALKS]
        environment = os.environ | {"PYTHONPATH": str(tmp_path)}
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path, check=True)
        seen.append(tuple(map(int, done.stdout.split())))
    assert seen == [(100, 100), (37, 37)]


def test_results_of_another_computer_are_told(tmp_path, monkeypatch):
    runs = [Run(train_toy, ToyConfig(), seed) for seed in range(2)]
    monkeypatch.setattr("lt_lib.store.run.computer", lambda: "unused in this process")
    RunStore(tmp_path, 1).fetch(runs[:1], "toys")
    (path,) = tmp_path.glob("*/*.run")
    head = path.read_bytes().partition(b"\n")[0].decode()
    assert head.split(" ", 2)[2].startswith(computer.processor())
    for name in filter(computer.CHOOSES.fullmatch, list(os.environ)):
        monkeypatch.delenv(name)  # whoever runs the tests may have chosen too
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    assert computer.computer() == f"{computer.processor()}, NUMBA_CPU_NAME=generic"
    altered = path.read_bytes().replace(computer.processor().encode(), b"another kind", 1)
    path.write_bytes(altered)  # the checksum covers the computer
    assert len(RunStore(tmp_path, 1).fetch(runs[:1], "toys")) == 1
    assert b"another kind" not in path.read_bytes()


# --- commits
def git(folder: Path, *arguments: str) -> None:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def repository(tmp_path) -> Path:
    folder = tmp_path / "repository"
    folder.mkdir()
    git(folder, "init", "-q")
    (folder / "a").write_text("a")
    git(folder, "add", "a")
    git(folder, "commit", "-qm", "a")
    return folder


def test_an_archive_inside_another_repository_has_no_commit_and_says_why(repository, monkeypatch):
    assert len(git_state(repository)["commit"]) == 40
    unpacked = repository / "unpacked"
    unpacked.mkdir()
    found = git_state(unpacked)
    assert found["commit"] is None and "it lies in that of repository" in found["no_commit"]
    monkeypatch.setenv("GIT_DIR", str(repository / ".git"))  # inside a hook of another repository
    assert git_state(unpacked)["commit"] is None
    monkeypatch.setenv("GIT_DIR", str(unpacked))
    assert len(git_state(repository)["commit"]) == 40


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give files away")
def test_a_checkout_of_another_owner_has_no_commit_and_says_why(repository):
    for path in (repository, *repository.rglob("*")):
        os.chown(path, 12345, 12345)
    found = git_state(repository)
    assert found["commit"] is None and "dubious ownership" in found["no_commit"]


# --- notebooks, folders, options
def test_a_copy_of_a_notebook_is_not_executed(project):
    shutil.copy(project / "notebooks" / "02_encoder.ipynb", project / "notebooks" / "02_encoder-Copy1.ipynb")
    shutil.copy(project / "notebooks" / "02_encoder.ipynb", project / "notebooks" / "02_encoder (1).ipynb")
    assert notebook_names(project) == ["02_encoder", "03_gridworld"]


@pytest.mark.parametrize("name", ["out{profile}", "out{1}", "out{{x}}", "{"])
def test_a_path_with_braces_is_taken_as_it_is(project, name):
    assert smoke(project, "--only", "02", "--outputs", str(project / name)) == 0
    assert (project / name / "notebooks" / "02_encoder.ipynb").is_file()
    assert not (project / "outsmoke").exists()


@pytest.mark.parametrize("text, complaint", [
    ("shared: {count: 1:30}", "count: expected int such as 2, got '1:30'"),
    ("shared: {count: 0100}", "count: expected int such as 2, got '0100'"),
    ("shared: {count: 2, count: 3}", "line 1: not valid YAML: 'count' is given twice"),
    ("shared: {outputs: x}", "shared: outputs comes from the command line (--outputs); leave it out"),
    ("02_encoder: {workers: 3}", "02_encoder: workers comes from the command line (--workers); leave it out"),
    ("? [a]\n: 1", "a key must be text or a number, got ['a']"),
    ("a: &x {count: 2}\nshared: {<<: *x}", "merge keys (<<) are not read; write the keys out"),
])  # fmt: skip
def test_yaml_means_what_it_says_or_is_refused_in_one_line(project, capfd, text, complaint):
    (project / "params" / "smoke.yaml").write_text(text)
    assert smoke(project) == 2
    line = capfd.readouterr().err
    assert complaint in line and line.startswith("run_all: ") and line.count("\n") == 1


def test_a_file_that_is_not_utf_8_is_named_with_its_line(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes("a: 1\n# café\n".encode("latin-1"))
    readers = (load_layout, load_claims, read_gates, load_inferred, read_yaml)
    for read in readers:
        with pytest.raises(UserError, match=r"a.yaml: line 2 is not UTF-8; save the file as UTF-8"):
            read(str(path) if read is load_layout else path)


def test_a_key_given_twice_in_a_layout_is_refused(tmp_path):
    path = tmp_path / "twice.yaml"
    path.write_text((LAYOUTS / "default.yaml").read_text() + "wall_height: 2.0\n")
    with pytest.raises(UserError, match="'wall_height' is given twice"):
        load_layout(str(path))


@pytest.mark.parametrize("name", notebook_names())
def test_every_number_that_a_notebook_takes_has_a_range(name):
    for key, value in notebook_defaults(ROOT / "notebooks" / f"{name}.ipynb").items():
        if type(value) in (int, float) and key != "workers":
            assert key in SECTIONS, f"{name}: {key} = {value} would be taken whatever it is"


@pytest.mark.parametrize("book, key, value", [("01_occlusion_check", "poses", 0), ("01_occlusion_check", "pixels", -5)])
def test_a_number_out_of_range_is_refused_before_computing(tmp_path, book, key, value):
    for folder in ("notebooks", "params"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    (tmp_path / "params" / "odd.yaml").write_text(f"{book}: {{{key}: {value}}}\n")
    with pytest.raises(UserError, match=f"{book}: {key}.* greater than"):
        load_profile("odd", tmp_path)


def test_a_link_to_nowhere_and_an_odd_number_of_cores_are_named(tmp_path, monkeypatch):
    (tmp_path / "runs").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match=r"runs is a link to .*elsewhere, which does not exist; create that"):
        writable_folder(tmp_path / "runs")
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "abc")
    with pytest.raises(UserError, match="LOKY_MAX_CPU_COUNT: expected a whole number of cores, at least 1, got 'abc'"):
        cores()


def test_worker_processes_that_cannot_start_are_told_in_one_line(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("lt_lib.store.local.get_reusable_executor", refuse)
    with pytest.raises(UserError, match=r"cannot start worker processes \(Read-only file system\); .* /dev/shm"):
        RunStore(tmp_path, 1).fetch([Run(train_toy, ToyConfig(), 0)], "toys")


def test_two_runs_at_once_on_one_store_list_their_own_alone(project, tmp_path):
    write_notebook(project, "03_gridworld", COMPUTE.replace("range(count)", "range(5, 6)"), WRITE)
    command = [
        sys.executable,
        "-c",
        "import pathlib, run_all, sys; sys.exit(run_all.main(sys.argv[2:], pathlib.Path(sys.argv[1])))",
    ]
    (project / "params" / "smoke.yaml").write_text("")
    running = [
        subprocess.Popen(
            [*command, str(project), "--profile", "smoke", "--only", only, "--outputs", str(tmp_path / only)]
        )
        for only in ("02", "03")
    ]
    assert [each.wait(600) for each in running] == [0, 0]
    for only, name, count in (("02", "02_encoder", 2), ("03", "03_gridworld", 1)):
        entry = json.loads((tmp_path / only / "manifest.json").read_text())["notebooks"][name]
        assert entry["stages"]["train_toy"]["runs"] == count and len(entry["computers"]) == 1


def test_the_user_s_matplotlibrc_changes_no_figure(tmp_path):
    (tmp_path / "matplotlibrc").write_text("font.size: 30\nsavefig.bbox: tight\ntext.usetex: True\n")
    code = "import matplotlib as m, lt_lib.report.style; print(*map(m.rcParams.get, ('font.size', 'text.usetex')))"
    environment = os.environ | {"MATPLOTLIBRC": str(tmp_path), "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout.split() == [str(matplotlib.rcParamsDefault["font.size"]), "False"]


# --- the report
@pytest.fixture
def outputs(tmp_path) -> Path:
    folder = tmp_path / "<b>outputs"
    for name in ("notebooks", "figures"):
        (folder / name).mkdir(parents=True)
    cell = nbformat.v4.new_code_cell("profile = '<script>alert(1)</script>'")
    picture = io.BytesIO()
    Picture.new("RGB", (1, 1)).save(picture, "png")
    pictures = {"image/png": base64.b64encode(picture.getvalue()).decode()}
    cell.outputs = [nbformat.v4.new_output("stream", text="frames of <script>alert(2)</script>")]
    cell.outputs.append(nbformat.v4.new_output("display_data", data=pictures))
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), folder / "notebooks" / "02_encoder.ipynb")
    row = dict.fromkeys(COLUMNS, "") | {"id": "a", "notebook": "02_encoder", "note": "<script>alert(3)</script>"}
    pd.DataFrame([row]).to_csv(folder / "scoreboard.csv", index=False)
    (folder / "headline.md").write_text("<script>alert(4)</script>")
    made = {"profile": "<script>alert(5)</script>", "versions": {"<i>x": 1}, "machine": {}}
    (folder / "manifest.json").write_text(json.dumps(made))
    return folder


def test_no_name_or_parameter_becomes_a_script_of_the_report(outputs):
    report = write_report(outputs).parent
    for page in (report / f"{name}.html" for name in ("index", "scoreboard", "made", "notebooks/02_encoder")):
        text = page.read_text()
        assert "<script>alert" not in text and "<i>x" not in text
        assert "alert" in text or page.stem == "made"


def test_the_site_leaves_nothing_beside_itself(outputs):
    before = set(outputs.iterdir())
    assert (write_report(outputs).parent / "notebooks" / "02_encoder.html").exists()
    assert set(outputs.iterdir()) == before | {outputs / "report"}


@pytest.mark.parametrize("file", ["manifest.json", "notebooks/02_encoder.ipynb"])
def test_a_truncated_file_is_named_by_the_report_command(outputs, file, capsys):
    path = outputs / file
    path.write_bytes(path.read_bytes()[:-40])
    assert report(["--outputs", str(outputs)]) == 2
    line = capsys.readouterr().err
    assert line.startswith("report: ") and path.name in line and line.count("\n") == 1


def test_the_report_command_works_without_docstrings(outputs):
    command = [sys.executable, "-OO", "-m", "lt_lib.report.site", "--outputs", str(outputs)]
    assert subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode == 0


# --- files that are read: nothing in them is executed, whatever is done to them
class Planted:
    """Unpickled, it leaves a trace."""

    def __reduce__(self):
        return os.mkdir, (str(TRACE),)


TRACE = Path("/tmp") / f"lt-planted-{os.getpid()}"


@pytest.fixture
def kept(tmp_path) -> dict:
    """Every kind of file that we read back: its path, and how it is read."""
    layout = load_layout("default")
    save_frozen(tmp_path, "encoder", {"w": np.arange(40.0)}, layout, {"settings": {}})
    store = RunStore(tmp_path / "runs", 1)
    run = Run(train_toy, ToyConfig(), 0)
    store.fetch([run], "toys")
    (file,) = (tmp_path / "runs").glob("*/*.run")
    curve = Curve(centre=4.0, width=1.0, replicates=((4.0, 1.0), (4.1, 0.9)), made_of="a test")
    keep_curves({"a": curve}, "a", tmp_path)
    outputs = tmp_path / "outputs"
    findings = Findings("01_occlusion_check", outputs, "full")
    for name, claim in findings.claims.items():
        findings.add(name, claim.paper)
    findings.write()
    return {
        "weights": (tmp_path / "encoder.safetensors", lambda: load_frozen(tmp_path, "encoder", layout)),
        "sidecar": (tmp_path / "encoder.json", lambda: load_frozen(tmp_path, "encoder", layout)),
        "run": (file, lambda: store.fetch([run], "toys")),
        "curves": (tmp_path / CURVES, lambda: load_curve(path=tmp_path / CURVES)),
        "results": (
            outputs / "results" / "01_occlusion_check.json",
            lambda: read_findings(outputs, load_claims(), "full"),
        ),
    }


def test_a_pickle_planted_in_any_file_is_not_executed(kept):
    assert not TRACE.exists()
    for name, (path, read) in kept.items():
        path.write_bytes(pickle.dumps(Planted()))
        try:
            read()
        except UserError as error:
            assert len(str(error).splitlines()) == 1, name
        assert not TRACE.exists(), name


@pytest.mark.parametrize("kind", ["weights", "sidecar", "curves", "results"])
def test_no_altered_file_is_taken_for_what_it_was(kept, kind):
    path, read = kept[kind]
    whole, before, rng = path.read_bytes(), repr(read()), np.random.default_rng(0)
    for _ in range(60):
        data = bytearray(whole)
        where = int(rng.integers(len(data)))
        match rng.integers(3):
            case 0:
                data[where] ^= 1 << int(rng.integers(8))
            case 1:
                del data[where : where + int(rng.integers(1, 50))]
            case 2:
                data[where:where] = b"7"
        path.write_bytes(bytes(data))
        try:
            assert repr(read()) == before  # a space, or the case of a digit of the checksum
        except UserError as error:
            assert len(str(error).splitlines()) == 1


YAMLS = {
    "layout": (LAYOUTS / "default.yaml", lambda path: load_layout(str(path))),
    "claims": (ROOT / "params" / "claims.yaml", load_claims),
    "inferred": (ROOT / "params" / "inferred.yaml", load_inferred),
    "gates": (ROOT / "params" / "gates" / "hardware.yaml", read_gates),
    "profile": (ROOT / "params" / "full.yaml", None),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", YAMLS)
def test_every_mutation_of_a_yaml_file_is_read_or_refused_in_one_line(kind, tmp_path):
    source, read = YAMLS[kind]
    if read is None:
        shutil.copytree(ROOT / "notebooks", tmp_path / "notebooks")
        (tmp_path / "params").mkdir()

        def read(path):
            shutil.copy(path, tmp_path / "params" / "mutated.yaml")
            return load_profile("mutated", tmp_path)

    whole, rng, path = source.read_bytes(), np.random.default_rng(0), tmp_path / "mutated.yaml"
    for _ in range(60 if kind == "claims" else 250):
        data = bytearray(whole)
        for _ in range(int(rng.integers(1, 4))):
            where = int(rng.integers(len(data)))
            match rng.integers(3):
                case 0:
                    data[where] = int(rng.integers(256))
                case 1:
                    del data[where : where + int(rng.integers(1, 30))]
                case 2:
                    data[where:where] = rng.choice(
                        [b"[", b"{", b": ", b"- ", b"\t", b"&a ", b"*a", b"!!python/x ", b"<<: "]
                    )
        path.write_bytes(bytes(data))
        try:
            read(path)
        except UserError as error:
            assert len(str(error).splitlines()) == 1, bytes(data)
