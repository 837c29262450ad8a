"""The examples of README and docs/ do what they say: Python as printed, diffs applied to a copy, the citation."""

import re
import runpy
import shutil
import subprocess
import sys

import pytest
import torch
import yaml

from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import load_layout
from lt_lib.report.readme import README
from lt_lib.settings.base import ROOT

PAGES = (README, *(ROOT / "docs" / f"{name}.md" for name in ("reuse", "extending")))
TEXT = "\n\n".join(path.read_text(encoding="utf-8") for path in PAGES)
PYTHON = {section: re.findall(r"```python\n(.*?)```", body, re.DOTALL) for section, body in
          re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", TEXT, re.DOTALL | re.MULTILINE)}  # fmt: skip
DIFFS = dict(re.findall(r"^\*\*(?:A|An) ([\w ]+)\*\*.*?```diff\n(.*?)```", TEXT, re.DOTALL | re.MULTILINE))
NEEDED = ("run_all.py", "lt_lib", "notebooks", "params", "outputs/full/weights")
LIMIT_S = 600


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Executes an example as printed, in the project's folder; gives the names that it has left."""
    monkeypatch.chdir(ROOT)

    def executed(section: str, number: int = 0) -> dict:
        path = tmp_path / "example.py"
        path.write_text(PYTHON[section][number], encoding="utf-8")
        return runpy.run_path(str(path))

    return executed


def test_the_frozen_weights_load_in_three_lines_and_encode_what_a_camera_sees(run):
    (example,) = PYTHON["The frozen weights in three lines"]
    assert len(example.splitlines()) == 3
    layout = load_layout("default")
    scout = layout.scout.array[None].repeat(2, axis=0)
    frames = FastCamera(layout).frames(scout, [0, 1], layout.spawn.array[None, :2].repeat(2, axis=0))
    latents = run("The frozen weights in three lines")["encoder"].latent(frames)
    assert latents.shape == (2, 64)
    assert torch.dist(*latents) > 1  # the slab's corridor shows


def test_the_environments_step_as_printed(run):
    assert run("The task for your own learner")["frame"].shape == (64, 64, 3)
    team = run("The task for your own learner", 1)
    assert team["wire"].shape == (66,)
    assert (team["wire"][2:] == team["actions"]["scout"]).all()


# --- the diffs

# Episodes in which whoever takes the free corridor arrives, and a head that learns from them behind the real encoder.
TRAIN = """
import numpy as np
from pathlib import Path
from lt_lib.comm.messages import CONDITIONS, CONTENTS, Sender
from lt_lib.envs.layout import load_layout
from lt_lib.pixels.episodes import draw_scenes
from lt_lib.pixels.route import train_head
from lt_lib.settings.pixels import HeadConfig
from lt_lib.perception.weights import load_frozen
layout = load_layout("default")
encoder = load_frozen(Path("outputs/full/weights"), "encoder", layout)
entry, slab, route = np.indices((64, 2, 2))
ended = {"success": slab != route, "length": 0 * slab, "contacts": 0 * slab, "entered": route}
ended |= {"commit_step": 2, "held_out": 0.125}
bank = draw_scenes(layout, 64, np.random.default_rng(0))._asdict() | ended
def train(content, wire="intact"):
    config = HeadConfig(content=content, wire=wire, episodes=3000)
    return train_head(config, 0, report=lambda _: None, bank=bank, encoder=encoder)
"""
PROOFS = {
    "message content": TRAIN
    + """
assert train("signs")["optimal"][-500:].mean() > 0.9
""",
    "condition": TRAIN
    + """
import json
from types import SimpleNamespace
from lt_lib.preflight import check_inputs
from lt_lib.report.claims import Findings
from lt_lib.settings.pixels import PixelsConfig
from lt_lib.settings.profiles import load_profile
seeds = load_profile("full")["04_pixels"]["seeds"]
assert seeds["shuffled"] == 5
check_inputs({"seeds": seeds})
row = CONDITIONS["shuffled"]
trained = {"shuffled": [train(row.content, row.wire)] * 2, "latent": [train("latent")] * 2}
# the notebook's own cells, from its imports to its table, with these heads
cells = {cell["id"]: "".join(cell["source"]) for cell in json.load(open("notebooks/04_pixels.ipynb"))["cells"]}
imports = cells["c02"][: cells["c02"].index("require_opengl()")]
there = {
    "protocol": SimpleNamespace(trained_heads=lambda *_: trained, sizes=PixelsConfig()),
    "seeds": seeds, "episodes": None, "encoder_weights": None, "profile": "smoke",
    "folder": Path("outputs/smoke"), "findings": Findings("04_pixels", Path("outputs/smoke"), "smoke"),
}
for code in (imports, cells["c12a"], cells["c12"]):
    exec(code, there)
*lines, last = cells["c13"].strip().splitlines()
exec("\\n".join([*lines, f"table = {last}"]), there)
table = there["table"]
assert table["route opt."].str[:5].astype(float).between([0.3, 0.9], [0.7, 1]).all(), table
assert list(table["route opt., paper"] == "") == [True, False]
assert Path("outputs/smoke/figures/04_routes.png").exists()
""",
    "layout": """
import numpy as np
from run_all import make_plan, parse, preflight
from lt_lib.settings.base import ROOT
from lt_lib.envs.geodesic import RouteDistance
from lt_lib.environments.gym import ArenaEnv
from lt_lib.envs.layout import load_layout
plan = make_plan(parse(["--profile", "smoke"]), ROOT)
assert plan.parameters["04_pixels"]["layout"] == "far"
preflight(plan)
far, near = (RouteDistance(layout)(layout.spawn.array[None, :2], np.array([0]))
             for layout in map(load_layout, ("far", "default")))
assert abs(far - near - 2) < 0.1
frame, info = ArenaEnv("far").reset(seed=0)
""",
    "sender": """
from lt_lib.beyond.protocol import frozen
from lt_lib.beyond.readers import train_readers
from lt_lib.beyond.senders import SENDERS
from lt_lib.beyond.variance import perfect_bank
from lt_lib.settings.beyond import ReaderConfig, SenderConfig
quiet = lambda _: None
sender = frozen(SENDERS["thumbnail"].train(SenderConfig(kind="thumbnail", frames=512), 0, report=quiet))
config = ReaderConfig(sender="thumbnail", episodes=2000, heads=1)
read = train_readers(config, 0, report=quiet, bank=perfect_bank("default", 128), sender=sender)
assert read["greedy"].mean() > 0.95
""",
    "task": """
from lt_lib.beyond.deciders import MESSAGES, train_deciders
from lt_lib.settings.beyond import DeciderConfig
from lt_lib.perception.jepa import train_encoder
from lt_lib.settings.perception import EncoderConfig
quiet = lambda _: None
blank = train_encoder(EncoderConfig(frames=640, epochs=0.0), 0, report=quiet)
sender = {name: value for name, value in blank.items() if name[:2] == "E." or name in ("mean", "std")}
def learned(message):
    config = DeciderConfig(task="same side", message=message, scenes=2048, episodes=2000, heads=1)
    return train_deciders(config, 0, report=quiet, sender=sender)["reward"].mean()
assert learned("'same side' by hand") > 0.95 > 0.8 > learned("nothing")
""",
}


def test_the_pages_show_how_to_add_each():
    assert set(DIFFS) == set(PROOFS)
    assert all(len(diff.splitlines()) <= 30 for diff in DIFFS.values())


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("git") is None, reason="git applies the diffs, and is not installed here")
@pytest.mark.parametrize("what", PROOFS)
def test_what_the_pages_add_works(what, tmp_path):
    for name in NEEDED:
        source, target = ROOT / name, tmp_path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target)  # with its compiled code, which takes a while to make
        else:
            shutil.copy2(source, target)
    options = {"cwd": tmp_path, "capture_output": True, "text": True, "timeout": LIMIT_S}
    applied = subprocess.run(["git", "apply", "-"], input=DIFFS[what], check=False, **options)
    assert applied.returncode == 0, applied.stderr
    proven = subprocess.run([sys.executable, "-c", PROOFS[what]], check=False, **options)
    assert proven.returncode == 0, proven.stderr


def test_the_citation_is_of_this_version_and_names_the_paper_s_authors():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    version = re.search(r'^version = "(.*)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)[1]
    assert str(citation["version"]) == version and f"version {version}" in TEXT
    assert citation["cff-version"] == "1.2.0" and citation["authors"] and citation["message"]
    (paper,) = citation["references"]
    assert [author["family-names"] for author in paper["authors"]] == ["Wang", "Zheng", "Wu"]
    assert "(Wang, Zheng, Wu)" in TEXT and paper["title"] in " ".join(TEXT.split())
