"""What all figures share: colours by role, the stamp of sizes that give no results, and the folder."""

import io
import re
from pathlib import Path
from textwrap import fill

import matplotlib
from IPython.display import Image
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image as Picture

from lt_lib.report.claims import JUDGED

# Okabe and Ito's palette, which colour-blind readers can distinguish
ROLES = {
    "ours": "#0072B2", "diagnostic": "#009E73", "upper bound": "#E69F00",
    "lower bound": "#666666", "kinematic": "#CC79A7",
}  # fmt: skip
# What a message of each role tells, in words that need no paper beside them
MEANINGS = {
    "ours": "latent of what the scout sees", "diagnostic": "the answer itself", "upper bound": "the whole picture",
    "lower bound": "nothing", "kinematic": "where the scout is",
}  # fmt: skip
LEFT, RIGHT = "0.78", "0.35"  # the two corridors, in greys, since colours are taken
ENTERED = "#D55E00"  # a path into the corridor that a policy does not choose
PAPER = {"marker": "D", "ls": "", "mfc": "white", "mec": "black", "ecolor": "black", "ms": 6, "capsize": 3}
CHANCE = {"color": "black", "ls": ":", "lw": 1.2, "zorder": 0}
DPI = 130
TITLE = 1.15  # points of a title per inch of width, between 11 and 15
LETTERS = 138  # of a title per inch of width and point
LEAST = 0.75  # points of any text per inch of width, so that it can be read on a slide

# A user's matplotlibrc, with its fonts, boxes or LaTeX, would change every figure of a notebook that imports this
matplotlib.rcdefaults()


def chance_line(axes: Axes, level: float = 0.5, named: bool = False) -> None:
    """Draws the dotted line of chance at `level`, with its name at its right end where no legend has it."""
    axes.axhline(level, label="chance", **CHANCE)
    if named:
        place = {"xycoords": axes.get_yaxis_transform(), "ha": "right", "va": "bottom"}
        axes.annotate("chance", (0.99, level), xytext=(0, 2), textcoords="offset points", fontsize=9, **place)


def paper_mark(axes: Axes, x: float, mean: float, sd: float | None = None) -> None:
    """The paper's mean as a hollow diamond, with its standard deviation where it prints one."""
    axes.errorbar(x, mean, sd, **PAPER)


def wrapped(words: str) -> str:
    """A tick's words in lines that do not reach the next tick's."""
    return fill(words, 15, break_long_words=False)


def plain(words: str) -> str:
    """A label's words without the marks of its formulas, for tables: 'latent z_t'."""
    return re.sub(r"[${}]", "", words.replace(r"\hat{z}", "ẑ"))


def _captioned(figure: Figure, found: str, made_of: str) -> None:
    """Title and footer, and no text too small for the figure's width."""
    width = figure.get_figwidth()
    size = min(max(TITLE * width, 11), 15)
    figure.suptitle(fill(found, int(LETTERS * width / size)), fontsize=size)
    figure.supxlabel(fill(made_of, int(LETTERS * width / 9)), fontsize=9, color="0.35")
    figure.draw_without_rendering()  # ticks have labels from here on
    for text in figure.findobj(Text):
        text.set_fontsize(max(text.get_fontsize(), LEAST * width))
    for axes in figure.findobj(Axes):
        for way in (axes.xaxis, axes.yaxis):
            way.set_tick_params(labelsize=max([label.get_fontsize() for label in way.get_ticklabels()], default=9))


def finish(figure: Figure, found: str, profile: str, made_of: str, outputs: Path, name: str) -> Image:
    """Titles a figure with what was found, captions it, stamps it if it is smoke-sized, saves it as a PNG, returns it.

    found    the finding in a sentence, its numbers computed
    made_of  what the figure shows, e.g. 'n = 5 seeds per condition, last 500 of 6,000 episodes'
    name     file name in <outputs>/figures, e.g. '04_routes'
    """
    _captioned(figure, found, made_of if profile == JUDGED else f"profile {profile}; {made_of}")
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
