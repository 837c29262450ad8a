"""Pictures of the scene: Fig. 1, from where the slab can be seen, the layout that leaks, the two cameras compared."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from jaxtyping import Bool, UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle, Wedge

from lt_lib.envs.camera import colours
from lt_lib.envs.layout import SIDES, Layout, Pose
from lt_lib.envs.materials import HAZARD, MATERIALS
from lt_lib.envs.occlusion import Occlusion, SightMap
from lt_lib.envs.reference import ReferenceCamera, TopView

NAVIGATOR, SCOUT = "#E69F00", "#0072B2"  # Okabe and Ito's orange and blue
ZOOM = 12  # pixels either side of a leak
SIGHT = "viridis_r"


def four_pictures(layout: Layout, camera: ReferenceCamera, seen: Occlusion) -> Figure:
    """Fig. 1: (a, b) the arena, (c) the navigator's camera and (d) the scout's, under either placement of the slab.

    seen  the hazard pixels that are printed over (c) and (d), counted by the same camera
    """
    figure = Figure(figsize=(14, 6.2), layout="constrained")
    figure.suptitle(
        f"Who can see the slab: hazard pixels by MuJoCo's segmentation, of {camera.pixels**2:,} a frame",
        fontsize=10,
    )
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.3, 1))
    arena_above, arena_plan = upper.subplots(1, 2)
    places = [(f"(c) navigator, choice point {i + 1}", p, layout.scout) for i, p in enumerate(layout.choice_points)]
    places.append(("(d) scout at its post", layout.scout, layout.spawn))
    counts = [*seen.navigator, seen.scout]
    from_above(arena_above, layout, slab=0)
    arena_above.set_title("(a) in place of the physical arena's photograph: MuJoCo from above", fontsize=9)
    plan(arena_plan, layout, slab=0)
    robot(arena_plan, layout, layout.scout, SCOUT, "scout")
    robot(arena_plan, layout, layout.spawn, NAVIGATOR, "spawn")
    for i, point in enumerate(layout.choice_points):
        robot(arena_plan, layout, point, NAVIGATOR, f"choice\npoint {i + 1}")
    arena_plan.set_title("(b) the simulated arena, drawn from its layout file", fontsize=9)
    columns = lower.subplots(1, 2 * len(places))
    for i, axes in enumerate(columns):
        (who, eye, other), slab = places[i // 2], i % 2
        view(axes, camera, eye, slab, other)
        axes.set_title(f"{who}\nslab {SIDES[slab]}: {counts[i // 2][slab]:,} hazard pixels", fontsize=8.5)
    return figure


def count_table(seen: Occlusion) -> pd.DataFrame:
    """Hazard pixels, a row a viewpoint, a column a placement of the slab."""
    rows = {f"navigator, choice point {i + 1}": counts for i, counts in enumerate(seen.navigator)}
    columns = [f"slab {side}" for side in SIDES]
    return pd.DataFrame.from_dict(rows | {"scout at its post": seen.scout}, orient="index", columns=columns)


def view(axes: Axes, camera: ReferenceCamera, eye: Pose, slab: int, other: Pose) -> None:
    """What a robot at `eye` sees in MuJoCo, the other robot standing at `other`."""
    axes.imshow(camera.pictures(eye.array[None], [slab], other.array[None, :2])[0], interpolation="nearest")
    axes.set(xticks=[], yticks=[])


def from_above(axes: Axes, layout: Layout, slab: int) -> None:
    """MuJoCo's picture from above, axes in metres."""
    top = TopView(layout, 1000)
    axes.imshow(top.picture(layout.spawn.array, slab, layout.scout.array), extent=top.extent)
    axes.set(xlabel="x (m)", ylabel="y (m)")


def plan(axes: Axes, layout: Layout, slab: int) -> None:
    """The layout as a plan in metres: the slab's placement filled, the other one dashed."""
    for wall in layout.walls:
        axes.add_patch(_rectangle(wall.bounds, color=_colour(f"{wall.material}_x"), lw=0))
    axes.add_patch(_rectangle(layout.slab(slab).bounds, color=_colour("slab_z"), lw=0))
    axes.add_patch(_rectangle(layout.slab(1 - slab).bounds, fill=False, ec=_colour("slab_z"), ls="--", lw=1.2))
    axes.add_patch(Circle((layout.goal.x, layout.goal.y), layout.goal.radius, color=_colour("goal"), lw=0))
    axes.annotate("goal", (layout.goal.x, layout.goal.y), color="white", ha="center", va="center", fontsize=8)
    (x0, x1), (y0, y1) = layout.arena.x, layout.arena.y
    axes.set(aspect="equal", xlim=(x0 - 0.1, x1 + 0.1), ylim=(y0 - 0.1, y1 + 0.1), xlabel="x (m)", ylabel="y (m)")


def robot(axes: Axes, layout: Layout, pose: Pose, colour: str, name: str) -> None:
    """A disc with 0.9 m of its field of view, and its name behind its back."""
    half, back = layout.camera.fov / 2, -np.sign(np.cos(pose.array[2]))
    place = (pose.x + back * 1.5 * layout.robot.radius, pose.y)
    axes.annotate(name, place, ha="left" if back > 0 else "right", va="center", fontsize=8)
    axes.add_patch(
        Wedge((pose.x, pose.y), 0.9, pose.heading - half, pose.heading + half, color=colour, alpha=0.3, lw=0)
    )
    axes.add_patch(Circle((pose.x, pose.y), layout.robot.radius, color=colour, lw=0))


def _rectangle(bounds: Sequence[float], **style) -> Rectangle:
    x0, x1, y0, y1 = bounds
    return Rectangle((x0, y0), x1 - x0, y1 - y0, **style)


def _colour(material: str) -> tuple[float, ...]:
    return tuple(c / 255 for c in MATERIALS[material])


def sight_maps(maps: Mapping[str, tuple[Layout, Sequence[SightMap]]]) -> Figure:
    """From where on the near side the slab can be seen: a row a layout, a column a placement of the slab."""
    figure = Figure(figsize=(11, 3.9 * len(maps)), layout="constrained")
    axes = figure.subplots(len(maps), len(SIDES), squeeze=False)
    norm = LogNorm(1, max(2, *(np.nanmax(m.pixels) for _, pair in maps.values() for m in pair)))
    for row, (name, (layout, pair)) in zip(axes, maps.items(), strict=True):
        for slab, (ax, sight) in enumerate(zip(row, pair, strict=True)):
            plan(ax, layout, slab)
            seen, free = sight_dots(ax, sight, norm)
            ax.plot(*zip(*((p.x, p.y) for p in layout.choice_points), strict=True), "rx", ms=9, mew=2, zorder=4)
            ax.set_xlim(right=layout.routes[slab].slab.x[1] + 0.5)
            ax.set_title(f"{name}, slab {SIDES[slab]}: seen from {seen} of {free:,} places", fontsize=9)
    label = "hazard pixels, the most of 8 headings (grey dot: none; red cross: choice point)"
    figure.colorbar(ScalarMappable(norm, SIGHT), ax=axes, label=label, shrink=0.9)
    return figure


def sight_dots(axes: Axes, sight: SightMap, norm: LogNorm) -> tuple[int, int]:
    """A dot a place, coloured where the slab is seen; returns from how many places it is seen, and of how many."""
    x, y = np.meshgrid(sight.x, sight.y, indexing="ij")
    seen, free = sight.pixels > 0, np.isfinite(sight.pixels)
    axes.scatter(x[free & ~seen], y[free & ~seen], s=2, color="0.7")
    axes.scatter(x[seen], y[seen], c=sight.pixels[seen], s=14, norm=norm, cmap=SIGHT, zorder=3)
    return int(seen.sum()), int(free.sum())


def leak(layout: Layout, camera: ReferenceCamera, slab: int, point: int) -> Figure:
    """The navigator's frame at a choice point with the pixels that leak circled, and enlarged beside it."""
    pose, scout = layout.choice_points[point], layout.scout.array[None, :2]
    hazard = HAZARD[camera.frames(pose.array[None], [slab], scout)[0]]
    figure = Figure(figsize=(9, 4.6), layout="constrained")
    whole, near = figure.subplots(1, 2)
    for axes in (whole, near):
        view(axes, camera, pose, slab, layout.scout)
    whole.set_title(f"{layout.name}: navigator at choice point {point + 1}, slab {SIDES[slab]}", fontsize=9)
    near.set_title(f"around the leak: {hazard.sum()} hazard pixels of {hazard.size:,}", fontsize=9)
    if hazard.any():
        row, column = (centre.mean() for centre in np.nonzero(hazard))
        whole.add_patch(Circle((column, row), 2 * ZOOM, fill=False, ec="white", lw=2))
        near.set(xlim=(column - ZOOM, column + ZOOM), ylim=(row + ZOOM, row - ZOOM))
    return figure


def cameras(
    fast: UInt8[np.ndarray, "b h w"],
    reference: UInt8[np.ndarray, "b h w 3"],
    differ: Bool[np.ndarray, "b h w"],
    names: Sequence[str],
) -> Figure:
    """Fast camera, mujoco.Renderer and the pixels in which their materials differ, a row a pose."""
    figure = Figure(figsize=(7, 2.35 * len(fast) + 0.4), layout="constrained")
    rows = figure.subplots(len(fast), 3, squeeze=False)
    for row, name, ours, theirs, difference in zip(rows, names, colours(fast), reference, differ, strict=True):
        row[0].imshow(ours, interpolation="nearest")
        row[1].imshow(theirs, interpolation="nearest")
        row[2].imshow(difference, cmap="gray_r", vmin=0, vmax=1, interpolation="nearest")
        row[0].set_ylabel(name, fontsize=8)
        row[2].set_xlabel(f"{difference.sum()} of {difference.size:,} pixels", fontsize=8)
    for axes, title in zip(rows[0], ("fast camera", "mujoco.Renderer", "difference (black)"), strict=True):
        axes.set_title(title, fontsize=9)
    for axes in rows.flat:
        axes.set(xticks=[], yticks=[])
    return figure
