"""Fig. 2, the pipeline, drawn from the settings in use."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from lt_lib.comm import channel, messages
from lt_lib.envs.layout import Layout
from lt_lib.report.style import ROLES

FROZEN, TRAINED, GRADIENT = "#DCE9F5", "#FDE9C9", "#B22222"


def pipeline(layout: Layout) -> Figure:
    """Stage 1 (no labels, no reward) and stage 2 (the reward reaches only the route head)."""
    figure = Figure(figsize=(11, 3.9), layout="constrained")
    axes = figure.subplots()
    axes.set(xlim=(0, 12.5), ylim=(0, 4.4))
    axes.axis("off")
    pixels, width = layout.camera.pixels, channel.ANCHOR + messages.CONTENT
    boxes = {
        "frames": (0.1, 2.9, f"random rollouts\n{pixels}x{pixels} frames,\nno labels, no reward", "white"),
        "jepa": (2.5, 2.9, "joint-embedding\nprediction, variance,\ncovariance; auxiliary\nreconstruction", TRAINED),
        "scout": (0.1, 0.5, "the scout's frame,\nwhich shows the slab", "white"),
        "E": (2.5, 0.5, f"the scout's encoder,\nfrozen: {messages.CONTENT} floats", FROZEN),
        "wire": (
            4.9,
            0.5,
            f"wire: anchor {channel.ANCHOR}\n+ content {messages.CONTENT} = {width}\n{channel.LATENCY} step of latency",
            "white",
        ),
        "head": (7.3, 0.5, "the navigator's\nroute head: one draw\nper episode", TRAINED),
        "executor": (9.7, 0.5, "its executor, frozen:\nown view and route,\nnot the wire", FROZEN),
        "goal": (9.7, 2.9, "episode return:\n+1 arrival,\n-0.01 a contact step", "white"),
    }
    for x, y, text, colour in boxes.values():
        axes.add_patch(FancyBboxPatch((x, y), 1.9, 1.1, boxstyle="round,pad=0.06", fc=colour, ec="0.3"))
        axes.text(x + 0.95, y + 0.55, text, ha="center", va="center", fontsize=10)
    for tail, head in (
        ("frames", "jepa"),
        ("scout", "E"),
        ("E", "wire"),
        ("wire", "head"),
        ("head", "executor"),
    ):
        _arrow(
            axes,
            (boxes[tail][0] + 1.98, boxes[tail][1] + 0.55),
            (boxes[head][0] - 0.08, boxes[head][1] + 0.55),
            "0.2",
        )
    _arrow(axes, (3.45, 2.82), (3.45, 1.7), ROLES["ours"])
    axes.text(
        3.55,
        2.25,
        "gates, then freeze;\nsame copy on both robots",
        fontsize=10,
        va="center",
        color=ROLES["ours"],
    )
    _arrow(axes, (10.65, 1.7), (10.65, 2.82), "0.2")
    _arrow(axes, (9.62, 3.45), (8.25, 1.7), GRADIENT)
    axes.text(8.75, 2.7, "the only gradient ", fontsize=11, color=GRADIENT, ha="right", va="center")
    axes.text(0.1, 4.2, "Stage 1: perception", fontsize=11, weight="bold")
    axes.text(0.1, 1.85, "Stage 2: reward only", fontsize=11, weight="bold")
    for x, colour, text in ((5.1, TRAINED, "trained"), (6.3, FROZEN, "frozen")):
        axes.add_patch(FancyBboxPatch((x, 4.05), 0.25, 0.2, boxstyle="round,pad=0.02", fc=colour, ec="0.3"))
        axes.text(x + 0.35, 4.15, text, va="center", fontsize=9)
    return figure


def _arrow(axes: Axes, tail: tuple[float, float], head: tuple[float, float], colour: str) -> None:
    axes.add_patch(FancyArrowPatch(tail, head, arrowstyle="-|>", mutation_scale=14, color=colour, lw=1.4))
