"""A notebook's answer, on its first screen: shown empty at its start, and filled in at its end."""

import os
import re
from pathlib import Path

from IPython.display import DisplayHandle, Markdown, display

from lt_lib.report.claims import JUDGED
from lt_lib.report.front import TEMPLATES, filled, found_in, in_the_paper
from lt_lib.settings.base import ROOT

UNKNOWN = "…"  # a number that was not computed


class Answer:
    """The place for the answer of one notebook, whose words are its row of templates/notebooks.md."""

    def __init__(self, notebook: str):
        self.notebook = notebook
        self._place: DisplayHandle = display(Markdown("*The answer appears here at the end.*"), display_id=True)

    def give(self, outputs: Path, profile: str, figure: str) -> None:
        """Fills in the numbers that the notebook has written to its results, and the figure that shows it."""
        stamp = "" if profile == JUDGED else f" (profile {profile}: not a result)"
        # executed by run_all.py, a notebook lies beside its figures; in Jupyter, in the project
        here = Path.cwd() if Path.cwd() == ROOT / "notebooks" else outputs / "notebooks"
        picture = Path(os.path.relpath(outputs / "figures" / figure, here)).as_posix()
        self._place.update(Markdown(f"**Answer.** {sentence(self.notebook, outputs)}{stamp}\n\n![{figure}]({picture})"))


def sentence(notebook: str, outputs: Path) -> str:
    """A notebook's answer in words, with the numbers of an outputs folder."""
    rows = (TEMPLATES / "notebooks.md").read_text(encoding="utf-8")
    words = re.search(rf"\]\({notebook}\) \| (.*) \|", rows)[1]
    return filled(words, found_in(outputs), in_the_paper(), UNKNOWN)
