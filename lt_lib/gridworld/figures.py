"""Figures and tables of the gridworld's section: the map and who sees what, seeds solved, how it was learned."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from lt_lib.comm.messages import CONDITIONS
from lt_lib.envs.layout import SIDES
from lt_lib.gridworld.map import CELL, FREE, GOAL, HAZARD, RADIUS, UNKNOWN, WALL, Grid
from lt_lib.report.claims import Claim
from lt_lib.report.scene import NAVIGATOR, SCOUT
from lt_lib.report.shares import SOLVED, final_shares
from lt_lib.report.style import ROLES, chance_line
from lt_lib.store.run import Result

COLOURS = {
    UNKNOWN: ("not seen", "#3b3b3b"),
    FREE: ("free", "#f4f1ea"),
    WALL: ("wall", "#7d8ca3"),
    HAZARD: ("hazard slab", "#d7301f"),
    GOAL: ("goal", "#4bab5b"),
}
CELLS = ListedColormap([colour for _, colour in COLOURS.values()])
UNTOLD = ("floor", "position", "trajectory")  # contents that cannot say where the slab is


def board(axes: Axes, grid: Grid, slab: int) -> None:
    """The map in metres under one placement; cells from which the placements differ are hatched."""
    codes = np.where(grid.wall, WALL, FREE)
    codes[tuple(grid.cells[grid.goal].T)] = GOAL
    codes[tuple(grid.cells[grid.slab[slab]].T)] = HAZARD
    low, high = grid.centres.min(0) - 1.5 * CELL, grid.centres.max(0) + 1.5 * CELL  # the ring of outer wall too
    extent = (low[0], high[0], low[1], high[1])
    axes.imshow(codes.T, origin="lower", extent=extent, cmap=CELLS, vmin=UNKNOWN, vmax=GOAL)
    for x, y in grid.centres[grid.revealing] - CELL / 2:
        axes.add_patch(Rectangle((x, y), CELL, CELL, fill=False, hatch="///", ec="#b8860b", lw=0))
    axes.plot(*grid.centres[grid.posts].T, "s", color=SCOUT, ms=6)
    axes.set(xlabel="x (m)", ylabel="y (m)")


def patch(axes: Axes, codes: UInt8[np.ndarray, "h w"], colour: str, title: str) -> None:
    """What one robot sees, itself in the middle."""
    axes.imshow(codes.T, origin="lower", cmap=CELLS, vmin=UNKNOWN, vmax=GOAL)
    axes.plot(RADIUS, RADIUS, "o", color=colour, ms=5, mec="white")
    axes.set_title(title, fontsize=8.5)
    axes.set(xticks=[], yticks=[])


def who_sees_what(grid: Grid) -> Figure:
    """The map under either placement, and the patches at a choice cell and at the scout's post."""
    figure = Figure(figsize=(13, 6.4), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.15, 1))
    choices = [grid.at(point.x, point.y) for point in grid.layout.choice_points]
    for slab, axes in enumerate(upper.subplots(1, 2)):
        board(axes, grid, slab)
        axes.plot(*grid.centres[choices].T, "rx", ms=9, mew=2)
        axes.set_title(f"slab {SIDES[slab]}; spawn: any of the {len(grid.spawn)} cells left of the barrier", fontsize=9)
    places = {f"navigator at choice cell {i + 1}": (cell, NAVIGATOR) for i, cell in enumerate(choices)}
    places["scout at a post"] = (int(grid.posts[len(grid.posts) // 2]), SCOUT)
    columns = lower.subplots(1, 2 * len(places))
    for i, axes in enumerate(columns):
        (name, (cell, colour)), slab = list(places.items())[i // 2], i % 2
        patch(axes, grid.patches[cell, slab], colour, f"{name}\nslab {SIDES[slab]}")
    keys = [Patch(fc=colour, ec="0.5", label=name) for name, colour in COLOURS.values()]
    keys.append(Patch(fc="white", ec="#b8860b", hatch="///", label="the placements look different from here"))
    keys.append(Line2D([], [], color="r", marker="x", ls="", label="choice cell"))
    keys.append(Line2D([], [], color=SCOUT, marker="s", ls="", label="scout's posts"))
    lower.legend(handles=keys, loc="outside lower center", ncols=len(keys), fontsize=8.5)
    return figure


def latent_map(reports: Mapping[str, Result]) -> Figure:
    """t-SNE of the latents of all views, an encoder a panel, coloured by whether the slab is in view."""
    figure = Figure(figsize=(3.4 * len(reports), 3.3), layout="constrained")
    for axes, (name, report) in zip(figure.subplots(1, len(reports), squeeze=False)[0], reports.items(), strict=True):
        seen = report["latent.hazard"].astype(bool)
        axes.scatter(*report["latent.plane"][~seen].T, s=14, color="0.7", label="no hazard in view")
        axes.scatter(*report["latent.plane"][seen].T, s=14, color="#B22222", label="hazard in view")
        axes.set(xticks=[], yticks=[], title=name, xlabel="t-SNE of the latent")
    axes.legend(fontsize=8)
    return figure


def solved(policies: Sequence[Result]) -> int:
    """How many seeds succeed in at least 0.9 of their last 500 training episodes."""
    return int((final_shares(policies, "success") >= SOLVED).sum())


def papers(claims: Mapping[str, Claim]) -> dict[str, str]:
    """How many seeds of each content the paper solved, in words."""
    untold = claims["grid.kinematic"]
    counts = {name: claims[f"grid.{name}"] for name in ("latent", "predicted", "raw")}
    told = {name: f"{claim.paper} of {claim.n}" for name, claim in counts.items()}
    return told | dict.fromkeys(UNTOLD, f"{untold.paper} of {untold.n // len(UNTOLD)}")


def seed_dots(groups: Mapping[str, Sequence[Result]], colours: Mapping[str, str], paper: Mapping[str, str]) -> Figure:
    """Success over the last 500 training episodes, sampled actions: a dot a seed, and how many solved the task."""
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    axes = figure.subplots()
    for x, (name, policies) in enumerate(groups.items()):
        shares = final_shares(policies, "success")
        axes.plot(
            x + np.linspace(-0.16, 0.16, len(shares)), shares, "o", color=colours[name], ms=7, mec="white", mew=0.8
        )
        axes.plot([x - 0.25, x + 0.25], [shares.mean()] * 2, color=colours[name], lw=2.5)
        words = f"{solved(policies)} of {len(policies)}" + (f"\n(paper {paper[name]})" if name in paper else "")
        axes.annotate(words, (x, 1.04), ha="center", va="bottom", fontsize=9)
    chance_line(axes)
    axes.axhline(SOLVED, color="0.6", lw=0.8, ls="--")
    axes.annotate("solved", (len(groups) - 0.52, SOLVED), fontsize=8, color="0.4", va="bottom", ha="right")
    axes.set_xticks(range(len(groups)), [name.replace(" ", "\n") for name in groups])
    axes.set(
        ylim=(0, 1.19),
        xlim=(-0.5, len(groups) - 0.5),
        ylabel="success, last 500 training episodes\n(share that reached the goal)",
    )
    axes.set_title("Seeds solved, of those trained. Dot: a seed; bar: the mean; dotted: chance", fontsize=11)
    return figure


def content_colours(names: Sequence[str]) -> dict[str, str]:
    """Contents in the colours of their roles, as in the pixel experiments."""
    return {name: ROLES[CONDITIONS[name].role] for name in names}


def learning_curves(policies: Mapping[str, Sequence[Result]], batch: int) -> Figure:
    """Success and episode length of the episodes that ended in each update, every seed drawn."""
    figure = Figure(figsize=(13, 4.8), layout="constrained")
    panels = figure.subplots(2, len(policies), sharex=True, sharey="row")
    colours = content_colours(list(policies))
    for (upper, lower), (name, seeds) in zip(panels.T, policies.items(), strict=True):
        for policy in seeds:
            steps = np.arange(1, len(policy["ended"]) + 1) * batch / 1e6
            for axes, key in ((upper, "success"), (lower, "length")):
                parts = np.split(policy[key], policy["ended"][:-1])
                means = [part.mean() if len(part) else np.nan for part in parts]
                axes.plot(steps, means, color=colours[name], lw=1, alpha=0.85)
        upper.set_title(name, fontsize=10)
        chance_line(upper)
        lower.set_xlabel("steps (millions)", fontsize=8)
    panels[0, 0].set(ylabel="success", ylim=(-0.03, 1.05))
    panels[1, 0].set(ylabel="episode length (steps)", ylim=(0, 103))
    return figure


def paths(policies: Mapping[str, tuple[Grid, Result]], slab: int, episodes: int) -> Figure:
    """Trajectories on the map, sampled actions: the first episodes with the slab in that corridor, a policy a panel."""
    figure = Figure(figsize=(6.2 * len(policies), 3.9), layout="constrained")
    panels = figure.subplots(1, len(policies), squeeze=False)[0]
    for axes, (title, (grid, result)) in zip(panels, policies.items(), strict=True):
        board(axes, grid, slab)
        rng = np.random.default_rng(0)  # of the sidestep that keeps paths apart
        for i in np.flatnonzero(result["slab"] == slab)[:episodes]:
            cells = grid.centres[result["sampled.cells"][i][: result["sampled.length"][i] + 1]]
            line = cells + rng.uniform(-0.14, 0.14, 2)
            axes.plot(*line.T, "-", lw=1.3, alpha=0.8, color=NAVIGATOR)
            axes.plot(*line[0], "o", ms=5, color=NAVIGATOR, mec="white")
        arrived = result["sampled.success"][result["slab"] == slab].mean()
        axes.set_title(f"{title}: {arrived:.0%} arrive", fontsize=9)
    return figure
