"""What people see in a browser, in a headless Chromium: the site, and a notebook run in JupyterLab."""

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, urlparse

import nbformat
import pandas as pd
import pytest
from axe_playwright_python.sync_playwright import Axe

from lt_lib.report.readme import FULL
from lt_lib.report.site import main, write_report
from lt_lib.settings.base import ROOT

pytestmark = pytest.mark.slow

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
LIMIT_S = 600
TOKEN = "of-this-test"
NOTEBOOK = "09_scoreboard.ipynb"
WITHOUT_CODE = "document.querySelectorAll('.cell_input').forEach(each => each.remove())"
LATEX = re.compile(r"\$[^$\n]*[\\_^][^$\n]*\$")
LOCAL = ("file", "data", "blob")
MISSING_PICTURES = "[...document.images].filter(i => !(i.complete && i.naturalWidth)).map(i => i.alt)"
LINKS = "[...document.querySelectorAll('a[href]')].map(a => a.href)"
IDS = "[...document.querySelectorAll('[id]')].map(e => e.id)"
WIDTH = "document.documentElement.scrollWidth"
SERIOUS = ("serious", "critical")
HERE = {"preload": False}  # reads no style sheet anew, which a page from a file may not
WINDOWS = {1300: "light", 390: "dark"}  # pixels wide


@pytest.fixture(scope="module")
def browser():
    if not CHROMIUM:
        pytest.skip("no Chromium on the PATH (Debian: apt install chromium)")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM)
        yield chromium
        chromium.close()


# --- the site


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    """The site of the committed full run, made in a copy of it."""
    if not (FULL / "scoreboard.md").exists():
        pytest.skip("no full run is committed")
    outputs = tmp_path_factory.mktemp("full")
    shutil.copytree(FULL, outputs, dirs_exist_ok=True, ignore=shutil.ignore_patterns("report", "weights"))
    return write_report(outputs).parent


def pages_of(report: Path) -> list[str]:
    """Every page that readers see."""
    return sorted(str(path.relative_to(report)) for path in report.rglob("*.html") if path.parent.name[0] != "_")


class Visit(NamedTuple):
    """What a page was like in one window: console and requests, width, pictures that failed, links, text."""

    said: list[str]
    width: int
    missing: list[str]
    links: list[str]
    places: set[str]
    pictures: int
    text: str


@contextlib.contextmanager
def shown(browser, path: Path, width: int, scheme: str):
    """A page as it looks at a width in light or dark, and what it says on its console or asks others for."""
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page, said = context.new_page(), []
    page.on("console", lambda message: said.extend([message.text] if message.type in ("error", "warning") else []))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda sent: said.extend([sent.url] if urlparse(sent.url).scheme not in LOCAL else []))
    page.goto(path.as_uri(), wait_until="load")
    page.wait_for_timeout(300)
    yield page, said
    context.close()


@pytest.fixture(scope="module")
def visits(browser, report) -> dict[tuple[str, int], Visit]:
    """Every page in a wide light window and in a narrow dark one."""
    found = {}
    for name in pages_of(report):
        for width, scheme in WINDOWS.items():
            with shown(browser, report / name, width, scheme) as (page, said):
                measures = [page.evaluate(each) for each in (WIDTH, MISSING_PICTURES)]
                rest = page.evaluate(LINKS), set(page.evaluate(IDS)), page.locator(".bd-article img").count()
                page.evaluate(WITHOUT_CODE)  # in which a figure's labels are formulas
                found[name, width] = Visit(said, *measures, *rest, page.inner_text("main"))
    return found


def test_no_page_of_the_site_is_wider_than_its_window_or_says_or_loads_anything(visits):
    assert {name: visit.said for (name, _), visit in visits.items() if visit.said} == {}
    assert {name: visit.missing for (name, _), visit in visits.items() if visit.missing} == {}
    assert {name: visit.width for (name, width), visit in visits.items() if visit.width > width} == {}


def faults(browser, report: Path, names: list[str]) -> dict[tuple[str, int], list[str]]:
    """What axe finds serious on pages, in both windows."""
    found = {}
    for name in names:
        for width, scheme in WINDOWS.items():
            with shown(browser, report / name, width, scheme) as (page, _):
                serious = [v for v in Axe().run(page, options=HERE).response["violations"] if v["impact"] in SERIOUS]
                found[name, width] = [f"{each['id']}: {each['nodes'][0]['html'][:150]}" for each in serious]
    return {where: each for where, each in found.items() if each}


def test_axe_finds_no_serious_fault_on_the_first_page(browser, report):
    assert faults(browser, report, ["index.html"]) == {}


@pytest.mark.release
def test_axe_finds_no_serious_fault_on_any_page(browser, report):
    pages = pages_of(report)
    assert len(pages) > 22 and faults(browser, report, pages) == {}


def test_all_links_of_the_site_resolve_to_a_file_and_a_place_in_it(visits, report):
    places = {report / name: visit.places for (name, _), visit in visits.items()}
    for (name, _), visit in visits.items():
        for link in map(urlparse, visit.links):
            if link.scheme == "file":
                path = Path(unquote(link.path))
                assert path.exists(), (name, link.path)
                assert not link.fragment or path.suffix != ".html" or link.fragment in places[path], (name, link)


def test_a_notebook_s_page_shows_its_pictures_and_no_formula_that_nothing_typesets(visits):
    for path in (FULL / "notebooks").glob("*.ipynb"):
        visit = visits[f"notebooks/{path.stem}.html", 1300]
        assert visit.pictures >= pictures_of(path)
        assert "<IPython.core.display" not in visit.text, "a picture shown as text"
        assert not LATEX.search(visit.text), path.stem


def pictures_of(path: Path) -> int:
    """How many pictures a notebook's outputs have."""
    cells = nbformat.read(path, as_version=4).cells
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    return sum(bool({"image/png", "image/gif"} & {*output.get("data", {})}) for output in outputs)


def test_the_scoreboard_is_searched_and_filtered_offline(browser, report):
    with shown(browser, report / "scoreboard.html", 1300, "light") as (page, _):
        board = pd.read_csv(FULL / "scoreboard.csv", keep_default_na=False)
        page.wait_for_function("document.querySelectorAll('.dt-container .dt-info').length")
        assert f"{len(board)} entries" in page.inner_text(".dt-info")
        page.locator("input[type=search]").last.fill("peek")
        page.wait_for_timeout(300)
        told = page.inner_text(".dt-info")
        assert f"filtered from {len(board)} total entries" in told and " of 0 " not in told


def test_the_front_page_answers_the_question_with_the_committed_numbers(visits):
    text = visits["index.html", 1300].text
    assert "What should the scout send?" in text and "Answer." in text
    counts = (FULL / "headline.md").read_text(encoding="utf-8").splitlines()[-1]
    assert counts in text and "What did not come out" in text


def test_a_folder_without_outputs_is_refused_in_one_line(tmp_path, capsys):
    assert main(["--outputs", str(tmp_path)]) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"report: {tmp_path / 'scoreboard.csv'} is missing; run_all.py writes it\n")


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
