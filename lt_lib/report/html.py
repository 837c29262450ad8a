"""A profile's outputs as web pages that need no network: `python -m lt_lib.report.html --outputs outputs/full`.

<outputs>/report/index.html shows the scoreboard and the figures, and links to one page per executed notebook. Every
page embeds its pictures, so the folder can be copied anywhere.
"""

import argparse
import base64
import html
import json
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from nbconvert import HTMLExporter
from nbconvert.filters import markdown2html
from nbformat import ValidationError
from nbformat.reader import NotJSONError
from traitlets.config import Config

from lt_lib.report.scoreboard import MARKS
from lt_lib.settings.base import ROOT, UserError
from lt_lib.store.files import writable_folder, write_atomically

# This drops whatever nbconvert would load from the network: no notebook here has widgets, diagrams or LaTeX.
PAGE = """
{%- extends 'lab/index.html.j2' -%}
{%- macro picture(kind, output, resources) -%}
<div class="jp-RenderedImage jp-OutputArea-output">
<img src="data:{{ kind }};base64,{{ output.data[kind] | escape_html }}"
     alt="a figure of {{ resources.metadata.name | escape_html }}"/>
</div>
{%- endmacro -%}
{%- block html_head_js -%}{%- endblock -%}
{%- block html_head_js_mathjax -%}{%- endblock -%}
{%- block html_head_js_mermaidjs -%}{%- endblock -%}
{%- block body_header -%}{{ super() }}
<p class="jp-RenderedHTMLCommon"><a href="index.html">scoreboard, figures and all notebooks</a></p>
{%- endblock -%}
{%- block data_png -%}{{ picture('image/png', output, resources) }}{%- endblock -%}
{%- block data_other -%}{{ picture('image/gif', output, resources) }}{%- endblock -%}
"""
SHOWN_FIRST = ["text/html", "text/markdown", "image/gif", "image/png", "text/plain"]
PICTURES = {".png": "image/png", ".gif": "image/gif"}
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 75rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; margin: 1rem 0 } td, th { border-bottom: 1px solid #ddd; padding: .2rem .6rem }
td, th { text-align: left; vertical-align: top } td.verdict { font-weight: bold; white-space: nowrap }
.anchor-link { display: none } figure { margin: 2rem 0 } figure img { max-width: 100% } figcaption { color: #555 }
"""


def write_report(outputs: Path) -> Path:
    """Writes the pages for an output folder and returns the path of the index.

    Raises UserError if there is no scoreboard yet or if the folder cannot be written.
    """
    board, manifest = outputs / "scoreboard.md", outputs / "manifest.json"
    for needed in (board, manifest):
        if not needed.is_file():
            raise UserError(f"{needed} is missing; run_all.py writes it")
    folder = outputs / "report"
    writable_folder(folder)
    notebooks = sorted((outputs / "notebooks").glob("*.ipynb"))
    exporter = _exporter()
    for path in notebooks:
        try:
            page, _ = exporter.from_filename(str(path))
        except (NotJSONError, ValidationError, ValueError, KeyError) as error:
            raise UserError(f"{path} is no whole notebook ({type(error).__name__}); execute it again") from None
        write_atomically(folder / f"{path.stem}.html", page.encode())
    names = [path.stem for path in notebooks]
    try:
        made = dict(json.loads(manifest.read_text(encoding="utf-8")))
        text = index(made, names, board.read_text(encoding="utf-8"), outputs / "figures")
    except (ValueError, KeyError, TypeError, AttributeError):
        raise UserError(f"{manifest} is truncated or damaged; run_all.py writes it anew") from None
    write_atomically(folder / "index.html", text.encode())
    return folder / "index.html"


def _exporter() -> HTMLExporter:
    priority = Config({"NbConvertBase": {"display_data_priority": SHOWN_FIRST}})
    return HTMLExporter(config=priority, raw_template=PAGE, exclude_anchor_links=True)


def index(manifest: Mapping[str, Any], names: Sequence[str], board: str, figures: Path) -> str:
    """The first page, from run_all.py's manifest, the names of the executed notebooks and scoreboard.md."""
    title = f"Latent Telepathy, profile {html.escape(manifest['profile'])}"
    pictures = "".join(_figure(path, names) for path in sorted(figures.glob("*")) if path.suffix in PICTURES)
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style></head><body>
<h1>{title}</h1>
<h2>Notebooks</h2>
{_listing(manifest["notebooks"], names)}
{_scoreboard(board, names)}
<h2>Figures</h2>
{pictures}
<h2>Made with</h2>
<p>{html.escape(_told({**manifest["versions"], **manifest["machine"]}))}</p>
</body></html>
"""


def _told(facts: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in facts.items())


def _listing(entries: Mapping[str, Mapping[str, Any]], names: Sequence[str]) -> str:
    """Status and time of every notebook, each linked to its page if it has one."""
    rows = "".join(
        f"<tr><td>{_linked(name, names)}</td><td>{html.escape(entry['status'])}</td>"
        f"<td>{entry['seconds']:,.0f} s</td></tr>"
        for name, entry in sorted(entries.items())
    )
    return f"<table><tr><th>notebook</th><th>status</th><th>time</th></tr>{rows}</table>"


def _linked(name: str, names: Sequence[str]) -> str:
    shown = html.escape(name)
    return f'<a href="{quote(name)}.html">{shown}</a>' if name in names else shown


def _scoreboard(board: str, names: Sequence[str]) -> str:
    """scoreboard.md as HTML, one heading level lower, with linked notebooks and coloured verdicts."""
    escaped = html.escape(board, quote=False)  # notes may hold names of folders and parameters
    page = markdown2html(re.sub(r"^#", "##", escaped, flags=re.MULTILINE))
    for name in names:
        page = re.sub(rf"(<h3[^>]*>){name}", rf"\1{_linked(name, names)}", page)
        page = page.replace(f'<a href="notebooks/{name}.ipynb">{name}</a>', _linked(name, names))
    for mark in MARKS.values():  # the sign tells a verdict, whatever stands behind it
        cell = rf'<td class="verdict" style="color: {mark.colour}">\1</td>'
        page = re.sub(rf"<td>({re.escape(mark.sign)} [^<]*)</td>", cell, page)
    return page


def _figure(path: Path, names: Sequence[str]) -> str:
    """A figure with its name, linked to the notebook that its number names."""
    source = f"data:{PICTURES[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"
    maker = next((name for name in names if name[:2] == path.stem[:2]), "09_scoreboard")
    name = html.escape(path.stem)
    return f"""<figure><img src="{source}" alt="{name}">
<figcaption>{name}, from {_linked(maker, names)}</figcaption></figure>
"""


def main(arguments: Sequence[str]) -> int:
    """Runs the command line and returns the exit status: 2 for a folder without outputs, otherwise 0."""
    parser = argparse.ArgumentParser(
        prog="python -m lt_lib.report.html", description="Writes a profile's outputs as web pages."
    )
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "full", metavar="DIR")
    try:
        print(write_report(parser.parse_args(arguments).outputs))
    except UserError as error:
        print(f"report: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
