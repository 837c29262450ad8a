"""Writes the headline table of the committed full run into README.md: `python -m lt_lib.report.readme`."""

import json
import re
from pathlib import Path

from lt_lib.settings.base import ROOT

README = ROOT / "README.md"
FULL = ROOT / "outputs" / "full"
HEADLINE = re.compile(r"(<!-- headline: begin.*?-->\n).*?(<!-- headline: end -->)", re.DOTALL)


def refreshed(text: str, outputs: Path = FULL) -> str:
    """The README's text with its headline block as notebook 9 left it with the results of the full run."""
    written = (outputs / "headline.md").read_text(encoding="utf-8")
    table = f"Route optimality by message content (Table III), mean over seeds [95% interval]:\n\n{written}"
    return HEADLINE.sub(lambda found: f"{found[1]}{table}{computed_by(outputs)}\n{found[2]}", text)


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
