"""The map of the scene, and the colours of the two robots, in every figure and film that shows them."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from lt_lib.envs.layout import Layout
from lt_lib.envs.materials import MATERIALS

NAVIGATOR, SCOUT = "#E69F00", "#0072B2"  # Okabe and Ito's orange and blue


def plan(axes: Axes, layout: Layout, slab: int) -> None:
    """Draws the layout as a plan, axes in metres (Fig. 1b).

    slab  the placement that is drawn filled, with two corridors 0 left, 1 right; free corridors' slabs are dashed
    """
    for wall in layout.walls:
        axes.add_patch(_rectangle(wall.bounds, color=_colour(f"{wall.material}_x"), lw=0))
    for side, blocked in enumerate(layout.blocks[slab]):
        filled = {"color": _colour("slab_z"), "lw": 0}
        dashed = {"fill": False, "ec": _colour("slab_z"), "ls": "--", "lw": 1.2}
        axes.add_patch(_rectangle(layout.slab(side).bounds, **(filled if blocked else dashed)))
    axes.add_patch(Circle((layout.goal.x, layout.goal.y), layout.goal.radius, color=_colour("goal"), lw=0))
    axes.annotate("goal", (layout.goal.x, layout.goal.y), color="white", ha="center", va="center", fontsize=8)
    (x0, x1), (y0, y1) = layout.arena.x, layout.arena.y
    axes.set(aspect="equal", xlim=(x0 - 0.1, x1 + 0.1), ylim=(y0 - 0.1, y1 + 0.1), xlabel="x (m)", ylabel="y (m)")


def _rectangle(bounds: Sequence[float], **style) -> Rectangle:
    x0, x1, y0, y1 = bounds
    return Rectangle((x0, y0), x1 - x0, y1 - y0, **style)


def _colour(material: str) -> tuple[float, ...]:
    return tuple(c / 255 for c in MATERIALS[material])
