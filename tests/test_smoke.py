"""The real notebooks, end to end, at smoke size: undisturbed, and killed in the middle and started again."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
from test_counterexamples import CASES

from lt_lib.report.claims import load_claims
from lt_lib.report.scoreboard import COLUMNS
from lt_lib.settings.base import ROOT
from lt_lib.settings.profiles import notebook_names

pytestmark = pytest.mark.slow

COMMAND = [sys.executable, "run_all.py", "--profile", "smoke"]
LIMIT_S = 1200  # a slow machine with other work
NEEDED = ("run_all.py", "requirements.txt", "lt_lib", "notebooks", "params")


def run(root: Path, *only: str) -> subprocess.CompletedProcess:
    command = [*COMMAND, *(("--only", *only) if only else ())]
    return subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=LIMIT_S, check=False)


def journal(root: Path) -> list[dict]:
    """The finished runs, in the order of their finishing."""
    path = root / "outputs" / "runs" / "journal.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    return [line for line in lines if "key" in line]


@pytest.fixture(scope="module")
def undisturbed() -> Path:
    """The smoke outputs of this very checkout; the notebooks' own tests find its runs done."""
    for command in (COMMAND, [*COMMAND, "--beyond"]):
        finished = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT_S, check=False)
        assert finished.returncode == 0, finished.stdout + finished.stderr
    return ROOT / "outputs" / "smoke"


def test_every_notebook_leaves_results_figures_and_an_executed_copy(undisturbed):
    manifest = json.loads((undisturbed / "manifest.json").read_text())
    for name in notebook_names():
        assert manifest["notebooks"][name]["status"] == "ok"
        executed = json.loads((undisturbed / "notebooks" / f"{name}.ipynb").read_text())
        assert all(cell["outputs"] is not None for cell in executed["cells"] if cell["cell_type"] == "code")
        assert str(ROOT) not in json.dumps([cell.get("outputs") for cell in executed["cells"]])
    assert {path.stem for path in (undisturbed / "report" / "notebooks").glob("*.html")} == {*notebook_names()}
    figures = {path.name for path in (undisturbed / "figures").iterdir()}
    assert {"01", "02", "03", "04", "05", "06", "07", "08", "11", "12", "13", "14", "15"} <= {
        name[:2] for name in figures
    }
    assert "scoreboard.png" in figures


def test_every_notebook_answers_on_its_first_screen_with_its_figure_and_says_that_it_is_no_result(undisturbed):
    for name in notebook_names():
        executed = undisturbed / "notebooks" / f"{name}.ipynb"
        (cell,) = [cell for cell in json.loads(executed.read_text())["cells"] if cell.get("id") == "answer"]
        text = "".join(cell["outputs"][0]["data"]["text/markdown"])
        assert text.startswith("**Answer.** ") and "{{" not in text and "(profile smoke: not a result)" in text, name
        (picture,) = re.findall(r"!\[.*\]\((.*)\)", text)
        assert (executed.parent / picture).is_file(), name


def test_the_scoreboard_has_every_claim_once_and_gives_no_verdict_at_smoke_size(undisturbed):
    board = pd.read_csv(undisturbed / "scoreboard.csv", keep_default_na=False)
    assert list(board.columns) == COLUMNS
    assert list(board.id) == list(load_claims())
    assert set(board.verdict) <= {"", "not run"}
    made = board[board.notebook.isin(["01_occlusion_check", "02_encoder"])]
    assert (made.ours != "").all()
    assert "smoke" in (undisturbed / "scoreboard.md").read_text().lower()


def test_settings_are_the_paper_s(undisturbed):
    board = pd.read_csv(undisturbed / "scoreboard.csv", keep_default_na=False).set_index("id")
    fixed = board[board.index.str.startswith(("cfg.", "wire.")) & (board.index != "wire.ratio")]
    assert len(fixed) == 13
    pairs = zip(fixed.ours.astype(str), fixed.paper.astype(str), strict=True)
    assert all(ours == paper or float(ours) == float(paper) for ours, paper in pairs), fixed[["paper", "ours"]]


def test_every_row_is_judged_by_the_function_that_its_counterexample_refutes(undisturbed):
    judges = {name: getattr(case[0], "func", case[0]).__name__ for name, case in CASES.items()}
    found = {}
    for path in (undisturbed / "results").glob("*.json"):
        found |= json.loads(path.read_text()).get("findings", {})  # what is beyond the paper has predictions
    open_ = {"grid.peek_length"}  # added beside its judge's result where no policy peeks
    judged = {name: found[name]["judge"] for name in judges if name in found and name not in open_}
    assert judged == {name: judges[name] for name in judged} and len(judged) > 80


def test_killed_in_a_training_and_started_again_it_ends_with_the_same_results(undisturbed, tmp_path):
    for name in NEEDED:
        source = ROOT / name
        (shutil.copytree if source.is_dir() else shutil.copy2)(source, tmp_path / name)
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    first = subprocess.Popen([*COMMAND, "--only", "encoder"], cwd=tmp_path, **silent)
    deadline = time.time() + LIMIT_S
    while not any(entry["function"] == "train_encoder" for entry in journal(tmp_path)):
        assert first.poll() is None and time.time() < deadline
        time.sleep(0.02)
    os.kill(first.pid, signal.SIGKILL)  # one encoder is done, its neighbours are being trained
    first.wait()
    before = [entry["key"] for entry in journal(tmp_path)]
    again = run(tmp_path, "encoder")
    assert again.returncode == 0, again.stdout + again.stderr
    after = [entry["key"] for entry in journal(tmp_path)]
    assert after[: len(before)] == before and len(after) > len(before)
    assert len(set(after)) == len(after)  # no finished run was repeated
    resumed = tmp_path / "outputs" / "smoke" / "results" / "02_encoder.json"
    assert resumed.read_bytes() == (undisturbed / "results" / "02_encoder.json").read_bytes()
