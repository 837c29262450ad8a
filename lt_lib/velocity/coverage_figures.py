"""Figures and judgements of the coverage sweep (Table II, Section Effect of increased exploration noise)."""

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binomtest, fisher_exact, rankdata, spearmanr

from lt_lib.envs.layout import SIDES, Layout
from lt_lib.report import scene, stats
from lt_lib.report.claims import Claim
from lt_lib.report.style import ROLES
from lt_lib.settings.velocity import Exploration
from lt_lib.store.run import Result

HORIZON, WINDOW = 600, 40  # control steps: an episode, and the window of the paper's boost
# The seven rows of Table II by claim, and the two of the section after it
TABLE = {
    "cov.s055_t0": Exploration(sigma=0.55),
    "cov.s055_t30": Exploration(sigma=0.55, tau=30.0),
    "cov.s100_t0": Exploration(sigma=1.0),
    "cov.s100_t30": Exploration(sigma=1.0, tau=30.0),
    "cov.s100_t100": Exploration(sigma=1.0, tau=100.0),
    "cov.s165_t30": Exploration(sigma=1.65, tau=30.0),
    "cov.s165_t100": Exploration(sigma=1.65, tau=100.0),
}
WINDOWED = {
    "cov.window_ar": Exploration(sigma=1.65, tau=30.0, window=WINDOW),
    "cov.episode_ar": Exploration(sigma=1.65, tau=30.0),
}
EARLY, LATE = (0, 14, 28), (66, 73, 80)  # iterations between which the paper's two ranges are measured
ONCE = 0.5  # coverage of a route drawn once an episode from a uniform categorical
EXACT_UP_TO = 8  # rows whose orders are all enumerated


class Row(NamedTuple):
    """Counts over a row's episodes."""

    n: int
    covered: int  # entered the alternative corridor
    succeeded: int
    through: int  # succeeded, of those that never entered the alternative

    @property
    def shares(self) -> tuple[float, float]:
        """Coverage and success."""
        return self.covered / self.n, self.succeeded / self.n

    @property
    def competence(self) -> float:
        """Success where the alternative was not entered; NaN where every episode entered it."""
        return self.through / (self.n - self.covered) if self.covered < self.n else float("nan")


def rows(swept: Result, alternative: int) -> list[Row]:
    """The counts of every row of a sweep."""
    covered, success = swept["entered"][..., alternative], swept["success"]
    return [Row(len(c), int(c.sum()), int(s.sum()), int((s & ~c).sum())) for c, s in zip(covered, success, strict=True)]


def judge(row: Row) -> dict[str, Any]:
    """One row as a finding: coverage and success, Wilson's intervals, and whether the decision is rarely sampled."""
    intervals = np.array([stats.wilson(count, row.n) for count in (row.covered, row.succeeded)])
    p = binomtest(row.covered, row.n, ONCE, alternative="less").pvalue
    test = "exact binomial: coverage below the 0.5 of a route drawn once"
    found = {"value": row.shares, "low": intervals[:, 0], "high": intervals[:, 1]}
    return found | {"n": row.n, "test": test, "p": p, "holds": bool(p < 0.05)}


def opposition(found: Sequence[Row]) -> tuple[float, float]:
    """Spearman's correlation of coverage and success over rows, and its one-sided p that it is below 0.

    Up to EXACT_UP_TO rows every order is enumerated; beyond, scipy's t approximation. A constant column gives (0, 1).
    """
    coverage, success = np.array([row.shares for row in found]).T
    if np.ptp(coverage) == 0 or np.ptp(success) == 0:
        return 0.0, 1.0
    if len(found) > EXACT_UP_TO:
        return tuple(map(float, spearmanr(coverage, success, alternative="less")))
    a, b = (rankdata(values) - (len(found) + 1) / 2 for values in (coverage, success))
    orders = np.array(list(permutations(b))) @ a
    return float(a @ b / np.sqrt((a @ a) * (b @ b))), float(np.mean(orders <= a @ b + 1e-9))


def window_ratio(outside: int, inside: int, boost: float = 1.0) -> float:
    """Aggregate score-function gradient outside the window over that inside: (N_out / N_in) (sigma_in / sigma_out).

    outside, inside  control steps
    boost            sigma_in / sigma_out, of the boosted window over the policy's own noise

    Raises ValueError for steps or a boost that cannot be.
    """
    if inside <= 0 or outside < 0 or boost <= 0:
        raise ValueError(f"window_ratio: expected steps and a positive boost, got {outside}, {inside}, {boost}")
    return outside / inside * boost


def table(found: Mapping[str, Row], settings: Mapping[str, Exploration], paper: Mapping[str, Claim]) -> pd.DataFrame:
    """Table II, ours with Wilson's intervals beside the paper's."""
    lines = []
    for name, row in found.items():
        finding, line = judge(row), {"sigma": settings[name].sigma, "tau": settings[name].tau}
        for i, column in enumerate(("coverage", "success")):
            low, high = finding["low"][i], finding["high"][i]
            line[column] = f"{row.shares[i]:.2f} [{low:.2f}, {high:.2f}]"
            line[f"{column}, paper"] = f"{paper[name].paper[i]:.2f}"
        lines.append(line | {"success off the alternative": f"{row.competence:.2f}"})
    return pd.DataFrame(lines, index=pd.Index(found, name="claim"))


def sweep(found: Mapping[str, Row], settings: Mapping[str, Exploration], paper: Mapping[str, Claim]) -> Figure:
    """Table II as a picture: coverage and success by row, Wilson's intervals, the paper's values as diamonds."""
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    axes, x = figure.subplots(), np.arange(len(found))
    for i, (label, colour) in enumerate((("coverage", ROLES["ours"]), ("success", ROLES["upper bound"]))):
        judged = [judge(row) for row in found.values()]
        shares, low, high = (np.array([j[key][i] for j in judged]) for key in ("value", "low", "high"))
        place = x + (i - 0.5) * 0.24
        axes.errorbar(place, shares, [shares - low, high - shares], fmt="o", color=colour, capsize=3, label=label)
        told = [paper[name].paper[i] for name in found]
        axes.plot(place + 0.09, told, "D", mfc="white", mec=colour, ms=6, label=f"{label}, paper")
    axes.axhline(ONCE, color="black", ls=":", lw=1, label="coverage of one categorical draw")
    words = [f"σ {s.sigma:g}\nτ {s.tau:g}" + (f"\nfirst {s.window}" if s.window < HORIZON else "") for s in
             (settings[name] for name in found)]  # fmt: skip
    axes.set_xticks(x, words)
    axes.set(ylim=(-0.03, 1.05), ylabel="share of episodes", xlabel="imposed lateral noise")
    axes.set_title("What exploration reaches, and what it costs. Bars: Wilson's 95% intervals", fontsize=11)
    figure.legend(fontsize=8, loc="outside right upper")
    return figure


def paths(layout: Layout, swept: Result, settings: Sequence[Exploration], blocked: int) -> Figure:
    """The sweep's episodes on the map, a panel a row of settings; colour says which corridor was entered first."""
    columns = 3
    figure = Figure(figsize=(13, 2.75 * -(-len(settings) // columns)), layout="constrained")
    panels = figure.subplots(-(-len(settings) // columns), columns, squeeze=False, sharex=True, sharey=True)
    for axes in panels.flat[len(settings) :]:
        axes.set_visible(False)
    for axes, setting, path, entered in zip(panels.flat, settings, swept["path"], swept["entered"], strict=False):
        _draw_paths(axes, layout, path, entered, blocked)
        where = f", first {setting.window} steps" if setting.window < HORIZON else ""
        axes.set_title(f"σ {setting.sigma:g}, τ {setting.tau:g}{where}", fontsize=9)
        axes.label_outer()
    figure.suptitle(f"Orange: entered the alternative corridor ({SIDES[blocked]}, blocked); blue: did not", fontsize=10)
    return figure


def _draw_paths(axes: Axes, layout: Layout, path: np.ndarray, entered: np.ndarray, alternative: int) -> None:
    scene.plan(axes, layout, alternative)
    for points, sides in zip(path, entered, strict=False):
        colour = ROLES["upper bound"] if sides[alternative] else ROLES["ours"]
        axes.plot(*points.T, color=colour, lw=0.8, alpha=0.8)
    axes.set_xlim(layout.spawn.x - 0.8, layout.goal.x + 0.5)


def grid(found: Mapping[tuple[float, float], Row]) -> Figure:
    """The finer sweep: coverage, success and competence by sigma and tau, and the frontier of coverage and success."""
    sigmas, taus = (sorted({key[i] for key in found}) for i in (0, 1))
    figure = Figure(figsize=(14, 4.3), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    for axes, i, title in ((left, 0, "coverage"), (middle, 1, "success, incumbent corridor free")):
        shares = np.array([[found[sigma, tau].shares[i] for tau in taus] for sigma in sigmas])
        image = axes.imshow(shares, origin="lower", aspect="auto", vmin=0, vmax=1, cmap="viridis")
        for (row, column), share in np.ndenumerate(shares):
            axes.text(column, row, f"{share:.2f}", ha="center", va="center", fontsize=7.5, color="wk"[int(share > 0.6)])
        axes.set_xticks(range(len(taus)), [f"{tau:g}" for tau in taus])
        axes.set_yticks(range(len(sigmas)), [f"{sigma:g}" for sigma in sigmas])
        axes.set(xlabel="correlation time τ (control steps)", ylabel="lateral σ", title=title)
    figure.colorbar(image, ax=(left, middle), label="share of episodes", shrink=0.9)
    for tau, colour in zip(taus, np.linspace(0.15, 0.9, len(taus)), strict=True):
        points = np.array([found[sigma, tau].shares for sigma in sigmas])
        right.plot(*points.T, "o-", color=(colour, 0.35, 1 - colour), ms=5, lw=1, label=f"τ {tau:g}")
    right.plot([0, 1], [1, 0], color="0.6", ls="--", lw=1, label="every entry costs a success")
    right.set(xlabel="coverage", ylabel="success", xlim=(-0.03, 1.03), ylim=(-0.03, 1.05), title="the frontier")
    right.legend(fontsize=8)
    return figure


def boosts(trained: Mapping[str, Result], incumbent: int, block: int, paper: Mapping[str, Claim]) -> Figure:
    """Success where the slab blocks the incumbent, over iterations, and the boost, by what becomes of the boost."""
    figure = Figure(figsize=(9.5, 5.4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    places = {"ours": -0.12, "kinematic": 0.0, "lower bound": 0.12}  # beside each other, of a block's width
    for (name, result), (role, place) in zip(trained.items(), places.items(), strict=True):
        edges = np.arange(0, len(result["boost"]) + block, block)
        counts = alternative_success(result, incumbent, edges)
        low, high = np.array([stats.wilson(s, n) if n else (0.0, 1.0) for s, n in counts]).T
        mean = counts[:, 0] / np.maximum(counts[:, 1], 1)
        error = [mean - low, high - mean]
        middle = edges[1:] + (place - 0.5) * block
        upper.errorbar(middle, mean, error, fmt="o-", color=ROLES[role], capsize=3, label=name)
        lower.plot(np.arange(1, len(result["boost"]) + 1), result["boost"], color=ROLES[role])
    for edges, claim in ((EARLY, "cov.boost_early"), (LATE, "cov.boost_late")):
        upper.fill_between([edges[0], edges[-1]], *paper[claim].paper, color="0.8", zorder=0)
    upper.fill_between([], [], [], color="0.8", label="paper's range")
    upper.set(ylabel="success, slab in the\nincumbent corridor", ylim=(-0.03, 1.03))
    upper.legend(fontsize=8)
    upper.set_title("Training goes on with the bit, by the boost in an episode's first 40 steps", fontsize=11)
    lower.set(xlabel="iteration", ylabel="boost (times the\npolicy's own noise)")
    return figure


def alternative_success(result: Result, incumbent: int, edges: Sequence[int] | np.ndarray) -> np.ndarray:
    """(successes, episodes) between iteration edges: training episodes from the spawn with the incumbent blocked."""
    update, slab, _, arrived = result["episodes"].T
    kept = slab == incumbent
    counts = [np.histogram(update[kept] + 0.5, edges, weights=w)[0] for w in (arrived[kept], None)]
    return np.column_stack(counts).astype(np.int64)


class Block(NamedTuple):
    """Success with the incumbent blocked, between iteration edges: a finding of its range, and the counts."""

    finding: dict[str, Any]
    succeeded: int
    n: int

    @property
    def share(self) -> float:
        return self.succeeded / self.n if self.n else 0.0


def boosted_range(result: Result, incumbent: int, edges: Sequence[int] | np.ndarray) -> Block:
    """The least and the largest success between the edges; parts without an episode are left out, (0, 0) if all are."""
    counts = alternative_success(result, incumbent, edges)
    shares = [s / n for s, n in counts if n] or [0.0]
    succeeded, n = map(int, counts.sum(axis=0))
    return Block({"value": (min(shares), max(shares)), "n": max(1, n)}, succeeded, n)


def decay(early: Block, late: Block) -> float:
    """One-sided Fisher exact p that the alternative corridor succeeds more rarely late than early."""
    counts = [[block.succeeded, block.n - block.succeeded] for block in (early, late)]
    return float(fisher_exact(counts, alternative="greater").pvalue)


def finer(sigmas: Sequence[float], taus: Sequence[float]) -> dict[float, tuple[Exploration, ...]]:
    """The grid of the finer sweep, by sigma."""
    return {sigma: tuple(Exploration(sigma=sigma, tau=tau) for tau in taus) for sigma in sigmas}
