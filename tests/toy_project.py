"""A small project of its own for the tests of run_all.py: notebooks whose runs take milliseconds."""

import json
import subprocess
import sys
import time
from pathlib import Path

import nbformat

from run_all import main

LIMIT_S = 600  # for what takes seconds, on a busy machine

PARAMETERS = """profile = "smoke"
outputs = ""
workers = 0
count = 2
share = 0.5
content = "latent"
sizes = [1, 2]
toy = {}"""

COMPUTE = """import json
from pathlib import Path
from toy_runs import ToyConfig, train_toy
from lt_lib.store.files import runs_folder
from lt_lib.store.run import Run
from lt_lib.store.runs import RunStore
store = RunStore(runs_folder(Path(".")), workers)
results = store.fetch([Run(train_toy, ToyConfig(**toy), seed) for seed in range(count)], "toys")"""

WRITE = """path = Path(outputs or f"outputs/{profile}") / "results" / "NAME.json"
path.parent.mkdir(exist_ok=True)
path.write_text(json.dumps([result["loss"] for result in results]))"""

RAISE = 'raise ValueError("the gate\\nfailed")'


def write_notebook(root: Path, name: str, *cells: str, parameters: str = PARAMETERS) -> None:
    first = nbformat.v4.new_code_cell(parameters, metadata={"tags": ["parameters"]})
    rest = [nbformat.v4.new_code_cell(cell.replace("NAME", name)) for cell in cells]
    kernel = {"name": "python3", "display_name": "Python 3"}
    notebook = nbformat.v4.new_notebook(cells=[first, *rest], metadata={"kernelspec": kernel})
    nbformat.write(notebook, root / "notebooks" / f"{name}.ipynb")


def smoke(root: Path, *arguments: str) -> int:
    return main(["--profile", "smoke", "--workers", "1", *arguments], root)


def losses(root: Path, name: str) -> list[float]:
    return json.loads((root / "outputs" / "smoke" / "results" / f"{name}.json").read_text())


START = """import pathlib, run_all, sys
sys.exit(run_all.main(sys.argv[2:], pathlib.Path(sys.argv[1])))"""


def start(root: Path) -> subprocess.Popen:
    """run_all in a process of its own, on notebook 02 with runs of 1.5 seconds, one at a time."""
    # The process has no settings for 'toy', so the notebook has it by default.
    parameters = PARAMETERS.replace("toy = {}", "toy = {'seconds': 1.5}").replace("count = 2", "count = 3")
    write_notebook(root, "02_encoder", COMPUTE, WRITE, parameters=parameters)
    (root / "params" / "smoke.yaml").write_text("")
    command = [sys.executable, "-c", START, str(root), "--profile", "smoke", "--only", "02", "--workers", "1"]
    return subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def journal(root: Path) -> list[dict]:
    path = root / "outputs" / "runs" / "journal.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    return [line for line in lines if "key" in line]  # of runs, not of fetches


def wait_until(condition, seconds: float) -> None:
    limit = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < limit, "waited in vain"
        time.sleep(0.05)


def kept_files(folder: Path) -> dict[str, bytes]:
    """The result files of a run store."""
    return {path.name: path.read_bytes() for path in folder.glob("*/*.run")}
