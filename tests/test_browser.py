"""What people see in a browser, in a headless Chromium: the HTML report, and a notebook run in JupyterLab."""

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import unquote, urlparse

import nbformat
import pytest

from lt_lib.report.html import PICTURES, main, write_report
from lt_lib.report.readme import FULL
from lt_lib.settings.base import ROOT

pytestmark = pytest.mark.slow

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
LIMIT_S = 600
TOKEN = "of-this-test"
NOTEBOOK = "09_scoreboard.ipynb"
WITHOUT_CODE = "document.querySelectorAll('.jp-CodeCell .jp-Cell-inputWrapper').forEach(each => each.remove())"
LATEX = re.compile(r"\$[^$\n]*[\\_^][^$\n]*\$")
LOCAL = ("file", "data")
MISSING_PICTURES = "[...document.images].filter(i => !(i.complete && i.naturalWidth)).map(i => i.alt)"
LINKS = "[...document.querySelectorAll('a[href]')].map(a => a.href)"


@pytest.fixture(scope="module")
def browser():
    if not CHROMIUM:
        pytest.skip("no Chromium on the PATH (Debian: apt install chromium)")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM)
        yield chromium
        chromium.close()


# --- the report


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    """The report of the committed full run, made in a copy of it."""
    if not (FULL / "scoreboard.md").exists():
        pytest.skip("no full run is committed")
    outputs = tmp_path_factory.mktemp("full")
    shutil.copytree(FULL, outputs, dirs_exist_ok=True, ignore=shutil.ignore_patterns("report", "weights"))
    return write_report(outputs).parent


def complaints_of(page) -> list[str]:
    """What the page will say on its console, and what it will ask others for: a list that fills as it loads."""
    found: list[str] = []
    page.on("console", lambda message: found.append(message.text))
    page.on("pageerror", lambda error: found.append(str(error)))
    page.on("request", lambda sent: found.extend([sent.url] if urlparse(sent.url).scheme not in LOCAL else []))
    return found


def pictures_of(page: str) -> int:
    """How many pictures a page must have: the figures on the first one, a notebook's outputs on its own."""
    if page == "index":
        return sum(path.suffix in PICTURES for path in (FULL / "figures").iterdir())
    cells = nbformat.read(FULL / "notebooks" / f"{page}.ipynb", as_version=4).cells
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    return sum(bool({*PICTURES.values()} & {*output.get("data", {})}) for output in outputs)


def test_report_shows_every_picture_loads_nothing_from_elsewhere_and_says_nothing_on_the_console(browser, report):
    pages = sorted(report.glob("*.html"))
    notebooks = {path.stem for path in (FULL / "notebooks").glob("*.ipynb")}
    assert {path.stem for path in pages} == {"index", *notebooks}
    for path in pages:
        page = browser.new_page()
        complaints = complaints_of(page)
        page.goto(path.as_uri(), wait_until="load")
        assert complaints == [], path.name
        assert page.locator("script").count() == 0
        assert page.evaluate("document.images.length") == pictures_of(path.stem), path.name
        assert page.evaluate(MISSING_PICTURES) == [], path.name
        page.evaluate(WITHOUT_CODE)  # in which a figure's labels are formulas
        text = page.inner_text("body")
        assert "<IPython.core.display" not in text, "a picture shown as text"
        assert not LATEX.search(text), "a formula that nothing here typesets"
        linked = [Path(unquote(urlparse(link).path)) for link in page.evaluate(LINKS)]
        assert [link for link in linked if not link.exists()] == []
        if path.stem == "index":
            assert {link.stem for link in linked} >= notebooks
        page.close()


def test_report_s_first_page_has_every_row_of_the_scoreboard_with_its_verdict_in_colour(browser, report):
    page = browser.new_page()
    page.goto((report / "index.html").as_uri())
    text = (FULL / "scoreboard.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("|") and "verdict" not in line and "---" not in line]
    cells = page.locator("td.verdict")
    assert cells.count() == len(rows)
    assert page.inner_text("h2#Scoreboard + p") == text.splitlines()[2].strip("*")
    reproduced = cells.filter(has_text="✔ reproduced").first
    assert reproduced.evaluate("cell => getComputedStyle(cell).color") == "rgb(0, 114, 178)"


def test_a_folder_without_outputs_is_refused_in_one_line(tmp_path, capsys):
    assert main(["--outputs", str(tmp_path)]) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"report: {tmp_path / 'scoreboard.md'} is missing; run_all.py writes it\n")


# --- JupyterLab


@pytest.fixture
def lab(tmp_path):
    """A JupyterLab on a copy of the project: its address, and the copy."""
    for name in ("lt_lib", "notebooks", "params"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns(".ipynb_checkpoints"))
    places = {f"JUPYTER_{kind}_DIR": str(tmp_path / ".jupyter" / kind) for kind in ("CONFIG", "RUNTIME")}
    options = ["--no-browser", "--ip=127.0.0.1", "--port=0", f"--IdentityProvider.token={TOKEN}", "--allow-root"]
    log = (tmp_path / "lab.log").open("w")
    server = subprocess.Popen(
        [sys.executable, "-m", "jupyter", "lab", *options, f"--ServerApp.root_dir={tmp_path}"],
        cwd=tmp_path,
        env=os.environ | places | {"PYTHONPATH": str(tmp_path), "JUPYTERLAB_SETTINGS_DIR": str(tmp_path / ".jupyter")},
        stdout=log,
        stderr=log,
    )
    try:
        yield address(Path(places["JUPYTER_RUNTIME_DIR"]), server, log), tmp_path
    finally:
        server.terminate()
        server.wait(timeout=60)
        log.close()


def address(runtime: Path, server: subprocess.Popen, log) -> str:
    """Where the server listens, once it does."""
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline and server.poll() is None:
        for path in runtime.glob("jpserver-*.json"):
            with contextlib.suppress(ValueError):  # half written
                return json.loads(path.read_text())["url"]
        time.sleep(0.1)
    raise AssertionError(Path(log.name).read_text())


def test_a_notebook_opens_and_runs_all_its_cells_in_jupyterlab(browser, lab):
    url, root = lab
    page = browser.new_page()
    page.set_default_timeout(LIMIT_S * 1000)
    page.goto(f"{url}lab/tree/notebooks/{NOTEBOOK}?token={TOKEN}")
    page.get_by_text("Python 3 (ipykernel) | Idle").wait_for()
    page.get_by_role("menuitem", name="Run", exact=True).click()
    page.get_by_role("menuitem", name="Run All Cells", exact=True).click()
    deadline = time.monotonic() + LIMIT_S
    while not (done := executed(root / "notebooks" / NOTEBOOK)) and time.monotonic() < deadline:
        page.keyboard.press("Control+s")
        page.wait_for_timeout(500)
    assert done, "not all cells were executed"
    assert page.locator(".jp-RenderedImage img").first.evaluate("image => image.naturalWidth") > 0
    page.close()


def executed(path: Path) -> bool:
    """Whether a saved notebook has every code cell executed. Fails on an output that is an error."""
    try:
        cells = nbformat.read(path, as_version=4).cells
    except nbformat.reader.NotJSONError:  # being saved
        return False
    code = [cell for cell in cells if cell.cell_type == "code"]
    errors = [output for cell in code for output in cell.outputs if output.output_type == "error"]
    assert errors == []
    return all(cell.execution_count for cell in code)
