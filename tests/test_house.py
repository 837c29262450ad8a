"""The house itself: imports point one way, notebooks are prose without outputs, the README is not stale."""

import ast
import json
import re
import subprocess
import warnings

import pytest

from lt_lib.report.readme import FULL, README, refreshed
from lt_lib.settings.base import ROOT
from lt_lib.settings.profiles import notebook_names
from lt_lib.store.manifest import used_runs
from run_all import BEYOND

STUDIES = ("pixels", "velocity", "gridworld", "learnability", "hardware", "speed", "environments")
SHARED = {"settings": 0, "store": 1, "envs": 2, "perception": 3, "comm": 4, "ppo": 4, "report": 5}
FLOORS = SHARED | dict.fromkeys(STUDIES, 6)
LONGEST_CELL = 36
LONGEST_FUNCTION = 60
SMALL_FUNCTION = 15  # lines, in a notebook
LONGEST_S = {False: 60 * 60, True: 90 * 60}  # on two cores, from nothing: the paper, and beyond it
TRAIN_OR_EVALUATE = {name for name in notebook_names() if name[:2] not in ("01", "09", "10")}
FOLDER = re.compile(r"(?:^|[\s'\"(=])(/(?:home|root|tmp|usr|work|Users)/[^\s'\"]*)")

needs_a_full_run = pytest.mark.skipif(not (FULL / "scoreboard.csv").exists(), reason="no full run is committed")


def modules():
    return sorted((ROOT / "lt_lib").rglob("*.py"))


def imports(path):
    """The parts of lt_lib that a module imports, however it is written."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        yield from (name.split(".")[1] for name in names if name.startswith("lt_lib."))


def test_imports_point_down_or_sideways():
    seen = 0
    for path in modules():
        here = FLOORS.get(path.relative_to(ROOT / "lt_lib").parts[0].removesuffix(".py"))
        for there in imports(path):
            seen += 1
            assert here is None or FLOORS.get(there, 0) <= here, f"{path.name} imports {there}, which lies above it"
    assert seen > 50


def test_no_function_is_long():
    for path in [*modules(), ROOT / "run_all.py"]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno < LONGEST_FUNCTION, f"{path.name}: {node.name}"


@pytest.mark.parametrize("name", notebook_names())
def test_source_notebooks_are_short_cells_of_calls_without_outputs(name):
    notebook = json.loads((ROOT / "notebooks" / f"{name}.ipynb").read_text(encoding="utf-8"))
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert sum("parameters" in cell["metadata"].get("tags", []) for cell in code) == 1
    for cell in code:
        lines = "".join(cell["source"]).splitlines()
        assert not cell["outputs"] and cell["execution_count"] is None
        assert len(lines) <= LONGEST_CELL
        for node in ast.parse("\n".join(lines)).body:
            assert not isinstance(node, ast.ClassDef)
            assert not isinstance(node, ast.FunctionDef) or node.end_lineno - node.lineno < SMALL_FUNCTION


@pytest.mark.parametrize("path", sorted(FULL.glob("notebooks/*.ipynb")), ids=lambda path: path.stem)
def test_committed_notebooks_name_no_folder_of_the_machine_they_ran_on(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    shown = [
        "".join(each.get("text", each.get("data", {}).get("text/plain", "")))
        for cell in cells
        for each in cell.get("outputs", [])
    ]
    assert not FOLDER.findall("\n".join(shown))


def lagging() -> list[str]:
    """The notebooks whose committed outputs are not those of the present source."""
    manifest = json.loads((FULL / "manifest.json").read_text(encoding="utf-8"))["notebooks"]
    return [name for name in notebook_names() if name not in manifest or not executed_as_it_is(name)]


def executed_as_it_is(name: str) -> bool:
    """Whether the committed copy of a notebook is the present one, executed to its end."""
    paths = [folder / "notebooks" / f"{name}.ipynb" for folder in (ROOT, FULL)]
    present, executed = (json.loads(path.read_text(encoding="utf-8"))["cells"] for path in paths)
    own = [cell for cell in executed if "injected-parameters" not in cell["metadata"]["tags"]]
    same = ["".join(cell["source"]) for cell in own] == ["".join(cell["source"]) for cell in present]
    return same and all(cell["execution_count"] for cell in executed if cell["cell_type"] == "code")


@needs_a_full_run
def test_the_committed_outputs_are_readable_and_a_warning_names_those_that_lag_behind_the_source():
    board = (FULL / "scoreboard.csv").read_text(encoding="utf-8")
    assert board.count("\n") > 100
    for path in FULL.glob("results/*.json"):
        json.loads(path.read_text(encoding="utf-8"))
    if stale := lagging():
        warnings.warn(
            f"outputs/full lags behind the source in {', '.join(stale)}; a release needs it whole", stacklevel=1
        )


@pytest.mark.release
def test_the_committed_full_run_is_of_the_present_source_in_one_sitting_from_nothing():
    assert not lagging(), "run python run_all.py"
    manifest = json.loads((FULL / "manifest.json").read_text(encoding="utf-8"))
    notebooks = manifest["notebooks"]
    assert list(notebooks) == list(notebook_names())
    assert {entry["status"] for entry in notebooks.values()} == {"ok"}
    assert len({entry["commit"] for entry in notebooks.values()}) == 1
    assert not any(entry["uncommitted_changes"] for entry in notebooks.values())
    sittings = {name: entry["sitting"] for name, entry in notebooks.items()}
    used = used_runs(FULL)  # every execution of a notebook that uses no runs is a sitting of its own
    assert {name for name, sitting in sittings.items() if sitting["stages"]} >= TRAIN_OR_EVALUATE  # nothing was kept
    for beyond, longest in LONGEST_S.items():
        own = {name: sitting for name, sitting in sittings.items() if (name >= BEYOND) == beyond}
        assert len({sitting["commit"] for name, sitting in own.items() if used[name]}) == 1
        assert sum(sitting["seconds"] for sitting in own.values()) <= longest
    assert "not run" not in (FULL / "scoreboard.csv").read_text(encoding="utf-8")
    changed = source_changed_since(next(iter(notebooks.values()))["commit"])
    assert not changed, f"the source changed since the run: {changed}"


def source_changed_since(commit: str) -> list[str]:
    command = ["git", "diff", "--name-only", commit, "--", "lt_lib", "notebooks", "params", "run_all.py"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()


@needs_a_full_run
def test_the_readme_s_headline_is_that_of_the_committed_full_run():
    text = README.read_text(encoding="utf-8")
    assert refreshed(text) == text, "stale: run python -m lt_lib.report.readme"
