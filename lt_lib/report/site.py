"""An outputs folder as a site that needs no network: `python -m lt_lib.report.site --outputs outputs/full`.

Sphinx builds it, with MyST-NB for the notebooks: <outputs>/report/index.html is the front page; the scoreboard, the
figures, every executed notebook and the pages of docs/ follow. Nothing is executed.
"""

import argparse
import html
import io
import json
import logging
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import nbformat
import pandas as pd
from nbformat.reader import NotJSONError

from lt_lib.report.claims import JUDGED
from lt_lib.report.readme import answer, learned, notebooks
from lt_lib.report.scoreboard import LEGEND, told
from lt_lib.settings.base import ROOT, UserError
from lt_lib.store.files import writable_folder

DOCS = ROOT / "docs"
ROOTED = {"ASSUMPTIONS.md": "assumptions", "CHANGELOG.md": "changelog", "HARDWARE.md": "hardware"}
REFERENCE = ("running", "scale", "reuse", "extending", *ROOTED.values())
PICTURES = (".png", ".gif")
FOLDED = ("parameters", "injected-parameters")  # tags of cells that readers need not see first
FILM = "04_pair.gif"
STAMP = "**Profile {profile}: sizes that give no results.**"


class Cell(NamedTuple):
    """Where a claim is judged: the last heading before the cell, as an anchor, and the cell's own."""

    heading: str
    anchor: str


def write_report(outputs: Path) -> Path:
    """Builds the site of an output folder and returns the path of its first page.

    Raises UserError if there is no scoreboard yet, if a file is damaged or if the folder cannot be written.
    """
    for needed in ("scoreboard.csv", "headline.md", "manifest.json"):
        if not (outputs / needed).is_file():
            raise UserError(f"{outputs / needed} is missing; run_all.py writes it")
    folder = outputs / "report"
    writable_folder(folder)
    try:
        manifest = dict(json.loads((outputs / "manifest.json").read_text(encoding="utf-8")))
        profile, made = manifest["profile"], {**manifest["versions"], **manifest["machine"]}
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{outputs / 'manifest.json'} is truncated or damaged; run_all.py writes it anew") from None
    with tempfile.TemporaryDirectory() as place:
        source = Path(place) / "source"
        cells = _copied_notebooks(outputs, source)
        _copied_pages(source)
        if (outputs / "figures").is_dir():
            shutil.copytree(outputs / "figures", source / "figures")
        pages = {
            "index": front(outputs, profile, list(cells)),
            "scoreboard": scoreboard(outputs, cells),
            "figures": figures(outputs / "figures", list(cells)),
            "made": f"# Made with\n\n{html.escape(', '.join(f'{name} {value}' for name, value in made.items()))}\n",
        }
        for name, text in pages.items():
            (source / f"{name}.md").write_text(text, encoding="utf-8")
        _build(source, Path(place) / "site", Path(place) / "doctrees")  # MyST-NB leaves pictures beside what it builds
        shutil.copytree(Path(place) / "site", folder, dirs_exist_ok=True)
    return folder / "index.html"


def _copied_notebooks(outputs: Path, source: Path) -> dict[str, dict[str, Cell]]:
    """Copies the executed notebooks, their code cells with anchors; where each claim is judged, by notebook."""
    (source / "notebooks").mkdir(parents=True)
    found = {}
    for path in sorted((outputs / "notebooks").glob("*.ipynb")):
        try:
            notebook = nbformat.read(path, as_version=4)
        except (NotJSONError, nbformat.ValidationError, ValueError, KeyError) as error:
            raise UserError(f"{path} is no whole notebook ({type(error).__name__}); execute it again") from None
        found[path.stem] = _with_anchors(notebook)
        nbformat.write(notebook, source / "notebooks" / path.name)
    return found


def _with_anchors(notebook: nbformat.NotebookNode) -> dict[str, Cell]:
    """Gives every code cell an anchor and folds parameters; returns the cells by the claim ids that they name."""
    cells, named, heading = [], {}, ""
    for i, cell in enumerate(notebook.cells):
        if cell.cell_type == "code":
            anchor = f"cell-{i}"
            cells.append(nbformat.v4.new_markdown_cell(f'<span id="{anchor}"></span>'))
            for claim in re.findall(r"""["']([a-z]+\.[a-z0-9_.]+)["'.]""", cell.source):
                named.setdefault(claim.rstrip("."), Cell(heading, anchor))
            tags = cell.metadata.setdefault("tags", [])
            if "hide-input" not in tags and set(tags) & set(FOLDED):
                tags.append("hide-input")
        elif titles := re.findall(r"^#+ (.+)$", cell.source, re.MULTILINE):
            heading = _slug(titles[-1])
        cells.append(cell)
    notebook.cells = cells
    return named


def _slug(title: str) -> str:
    """The anchor that MyST gives a heading, which is GitHub's."""
    return re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-")


def _copied_pages(source: Path) -> None:
    """Copies docs/ and the pages of the project's root, their links turned to where things are in the site."""
    shutil.copytree(DOCS, source, dirs_exist_ok=True)
    for file, name in ROOTED.items():
        shutil.copy(ROOT / file, source / f"{name}.md")
    for name in REFERENCE:
        path = source / f"{name}.md"
        path.write_text(_relinked(path.read_text(encoding="utf-8")), encoding="utf-8")


def _relinked(text: str) -> str:
    """Links to pages of the site stay links; what lies outside of it is named."""
    for file, name in ROOTED.items():
        text = re.sub(rf"\]\((\.\./)?{file}", f"]({name}.md", text)
    return re.sub(r"\[([^\]]+)\]\((\.\./|outputs|lt_lib|params|CONTRIBUTING|README|notebooks)[^)]*\)", r"`\1`", text)


def front(outputs: Path, profile: str, names: Sequence[str]) -> str:
    """The first page: the question, the film, the answer, what did not come out and what is new; then the contents."""
    shown = outputs / "figures" / FILM
    film = (
        f"![One draw of the scene, with the scout's latent and without a message](figures/{FILM})"
        if shown.exists()
        else ""
    )
    if profile == JUDGED:
        linked = re.sub(r"\]\([^)]*?(\d\d_\w+)\.ipynb\)", r"](notebooks/\1.ipynb)", notebooks(outputs))
        parts = [answer(outputs), learned(outputs), "## Every notebook in a sentence", linked]
    else:
        parts = [STAMP.format(profile=html.escape(profile))]
    question = (
        "A scout sees which of two corridors is blocked; the navigator cannot. **What should the scout send?**\n\n"
        "[Scoreboard](scoreboard.md) · [Figures](figures.md) · [Running it](running.md) · [Reusing it](reuse.md)"
    )
    contents = [
        _tree("The results", ["scoreboard", "figures"]),
        _tree("Notebooks", [f"notebooks/{name}" for name in names]),
        _tree("Reference", [*REFERENCE, "made"]),
    ]
    return "\n\n".join(["# Latent Telepathy, reproduced", question, film, *parts, *contents]) + "\n"


def _tree(caption: str, pages: Sequence[str]) -> str:
    listed = "\n".join(pages)
    return f"```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{listed}\n```"


def scoreboard(outputs: Path, cells: Mapping[str, Mapping[str, Cell]]) -> str:
    """Every row of the scoreboard in a table that can be searched and filtered, linked to what made it."""
    from itables import to_html_datatable  # takes a second, which bad input need not wait for
    from itables.javascript import generate_init_offline_itables_html
    from itables.options import dt_bundle

    board = pd.read_csv(outputs / "scoreboard.csv", keep_default_na=False, dtype=str)
    rows = [_row(row, cells.get(row["notebook"], {})) for row in board.to_dict("records")]
    table = to_html_datatable(
        pd.DataFrame(rows),
        connected=False,  # from the bundle above it, not from the network
        allow_html=True,
        paging=False,
        showIndex=False,
        layout={"top1": "searchPanes", "topStart": None, "bottomStart": "info"},
        searchPanes={"layout": "columns-2", "columns": [0, 4], "initCollapsed": True, "cascadePanes": True},
        columnDefs=[{"targets": [0, 4], "searchPanes": {"show": True}}],
        classes="display compact",
    )
    counts = (outputs / "headline.md").read_text(encoding="utf-8").splitlines()[-1]
    return "\n\n".join(
        [
            "---\nhtml_theme.sidebar_secondary.remove: true\n---",
            "# Scoreboard",
            f"**{html.escape(counts)}**",
            f"```{{raw}} html\n{generate_init_offline_itables_html(dt_bundle)}\n{table}\n```",
            LEGEND,
        ]
    )


def _row(row: Mapping[str, str], cells: Mapping[str, Cell]) -> dict[str, str]:
    """A row for readers: section, claim with its links, values, verdict, test."""
    where = _judged_in(row["id"], cells)
    page = f"notebooks/{row['notebook']}.html"
    links = f'<a href="{page}#{where.heading}">section</a>, <a href="{page}#{where.anchor}">code</a>' if where else ""
    interval = f" [{_short(row['low'])}, {_short(row['high'])}]" if row["low"] else ""
    firm = float(row["firm"]) if row["firm"] else None
    note = f"<br><small>{html.escape(row['note'])}</small>" if row["note"] else ""
    return {
        "section": html.escape(row["notebook"].replace("_", " ")),
        "claim": f'<span id="{html.escape(row["id"])}">{html.escape(row["what"])}</span> <small>({links})</small>',
        "paper": _short(row["paper"]),
        "here": _short(row["ours"]) + interval,
        "verdict": html.escape(told(row["verdict"], firm)),
        "p": _short(row["p"]),
        "test": html.escape(row["test"]) + note,
    }


def _judged_in(claim: str, cells: Mapping[str, Cell]) -> Cell | None:
    """The cell that names a claim, or else the longest beginning of its id; else the first that names any."""
    parts = claim.split(".")
    beginnings = [".".join(parts[:n]) for n in range(len(parts), 1, -1)]
    return next((cells[name] for name in beginnings if name in cells), next(iter(cells.values()), None))


def _short(text: str) -> str:
    """Numbers in a cell with three decimals."""
    return re.sub(r"-?\d+\.\d{4,}(e-?\d+)?", lambda found: f"{float(found[0]):.3g}", html.escape(text))


def figures(folder: Path, names: Sequence[str]) -> str:
    """All figures, by the notebook that drew them."""
    parts = ["# Figures"]
    for name in names:
        drawn = sorted(path for path in folder.glob(f"{name[:2]}_*") if path.suffix in PICTURES)
        if drawn:
            pictures = "\n\n".join(f"![{path.stem} of notebook {name}](figures/{path.name})" for path in drawn)
            parts.append(f"## {name}\n\n[the notebook](notebooks/{name}.ipynb)\n\n{pictures}")
    return "\n\n".join(parts) + "\n"


def _build(source: Path, folder: Path, doctrees: Path) -> None:
    from sphinx.application import Sphinx  # takes a second, which bad input need not wait for
    from sphinx.util.docutils import docutils_namespace, patch_docutils

    said = io.StringIO()
    with patch_docutils(str(source)), docutils_namespace():
        Sphinx(source, source, folder, doctrees, "html", status=None, warning=said, freshenv=True).build()
    for warning in dict.fromkeys(said.getvalue().splitlines()):
        logging.getLogger(__name__).warning(warning)


def main(arguments: Sequence[str]) -> int:
    """Runs the command line and returns the exit status: 2 for a folder without outputs, otherwise 0."""
    parser = argparse.ArgumentParser(prog="python -m lt_lib.report.site", description="Builds the site of a profile.")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "full", metavar="DIR")
    try:
        print(write_report(parser.parse_args(arguments).outputs))
    except UserError as error:
        print(f"report: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
