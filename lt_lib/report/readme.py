"""Writes what the committed full run found into README.md: `python -m lt_lib.report.readme`."""

import json
import re
from collections.abc import Callable
from pathlib import Path

from lt_lib.report.front import page, table_three
from lt_lib.settings.base import ROOT

README = ROOT / "README.md"
FULL = ROOT / "outputs" / "full"


def answer(outputs: Path) -> str:
    """The paper's question answered, and Table III."""
    return f"{page('answer', outputs)}\n\n{table_three(outputs)}"


def learned(outputs: Path) -> str:
    """What did not come out, what is new, the counts, and what computed them."""
    counts = (outputs / "headline.md").read_text(encoding="utf-8").splitlines()[-1]
    return f"{page('learned', outputs)}\n\n{counts}\n{computed_by(outputs)}"


def notebooks(outputs: Path) -> str:
    """Every notebook with its answer, linked to its executed copy."""
    executed = outputs.relative_to(ROOT) / "notebooks" if outputs.is_relative_to(ROOT) else Path("notebooks")
    return re.sub(r"\]\((\d\d_\w+)\)", rf"]({executed.as_posix()}/\1.ipynb)", page("notebooks", outputs))


BLOCKS: dict[str, Callable[[Path], str]] = {each.__name__: each for each in (answer, learned, notebooks)}


def refreshed(text: str, outputs: Path = FULL) -> str:
    """The README's text with its blocks as the results of the full run have them."""
    for name, block in BLOCKS.items():
        marked = re.compile(rf"(<!-- {name}: begin.*?-->\n).*?(<!-- {name}: end -->)", re.DOTALL)
        written = block(outputs)
        text = marked.sub(lambda found, written=written: f"{found[1]}{written}\n{found[2]}", text)
    return text


def computed_by(outputs: Path) -> str:
    """Which source computed an outputs folder, with which torch, on what: its manifest in a sentence."""
    manifest = json.loads((outputs / "manifest.json").read_text(encoding="utf-8"))
    commits = dict.fromkeys(entry["commit"][:7] for entry in manifest["notebooks"].values())
    source = f"commit{'s' if len(commits) > 1 else ''} {', '.join(commits)}"
    versions, machine = manifest["versions"], manifest["machine"]
    return (
        f"Computed at {source} with Python {versions['python']} and torch {versions['torch']}, "
        f"on {machine['cores']} cores ({machine['cpu']}, {machine['system']})."
    )


if __name__ == "__main__":
    README.write_text(refreshed(README.read_text(encoding="utf-8")), encoding="utf-8")
