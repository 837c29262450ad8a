"""What all figures share: colours by role, the stamp of sizes that give no results, and the folder."""

import io
import re
from pathlib import Path
from textwrap import fill

import matplotlib
from IPython.display import Image
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image as Picture

from lt_lib.report.claims import JUDGED

# Okabe and Ito's palette, which colour-blind readers can distinguish
ROLES = {
    "ours": "#0072B2", "diagnostic": "#009E73", "upper bound": "#E69F00",
    "lower bound": "#666666", "kinematic": "#CC79A7",
}  # fmt: skip
CHANCE = {"color": "black", "ls": ":", "lw": 1.2, "zorder": 0}
DPI = 130
LETTERS = 11.5  # of a title per inch of width

# A user's matplotlibrc, with its fonts, boxes or LaTeX, would change every figure of a notebook that imports this
matplotlib.rcdefaults()


def chance_line(axes: Axes, level: float = 0.5) -> None:
    """Draws the dotted line of chance at `level`."""
    axes.axhline(level, label="chance", **CHANCE)


def wrapped(words: str) -> str:
    """A tick's words in lines that do not reach the next tick's."""
    return fill(words, 15, break_long_words=False)


def plain(words: str) -> str:
    """A label's words without the marks of its formulas, for tables: 'latent z_t'."""
    return re.sub(r"[${}]", "", words.replace(r"\hat{z}", "ẑ"))


def finish(figure: Figure, found: str, profile: str, made_of: str, outputs: Path, name: str) -> Image:
    """Titles a figure with what was found, captions it, stamps it if it is smoke-sized, saves it as a PNG, returns it.

    found    the finding in a sentence, its numbers computed
    made_of  what the figure shows, e.g. 'n = 5 seeds per condition, last 500 of 6,000 episodes'
    name     file name in <outputs>/figures, e.g. '04_routes'
    """
    figure.suptitle(fill(found, int(LETTERS * figure.get_figwidth())), fontsize=12)
    figure.supxlabel(f"profile {profile}; {made_of}", fontsize=8, color="0.35")
    if profile != JUDGED:
        figure.text(
            0.5, 0.5, f"{profile.upper()}: not a result", rotation=20, fontsize=34, alpha=0.13, ha="center", va="center"
        )
    folder = outputs / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.png"
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=DPI, format="png")
    # a palette of 256 colours, which nobody tells from all of them, is a third of the size
    picture = Picture.open(drawn).convert("RGB").quantize(256, dither=Picture.Dither.NONE)
    picture.save(path, optimize=True)
    return Image(filename=path)
