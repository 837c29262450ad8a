"""Figures and judgements of the point-mass study (Fig. 3) and of the predictor that it calibrates."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy import stats as scipy_stats

from lt_lib.learnability import sigmoid
from lt_lib.learnability.point_mass import enters_alternative, positions
from lt_lib.learnability.predictor import CURVES, LEVEL, SURE, Answer, Curve, Curves, z_score
from lt_lib.learnability.z_study import CEILING, CHANCE, Runs
from lt_lib.report import stats
from lt_lib.report.style import ROLES, chance_line
from lt_lib.store.files import write_atomically

ALPHA = 0.05
SHAPES = ("o", "s", "^", "D", "v")  # one a window length, short to long
OURS, CONTROL, DIRECT = ROLES["ours"], ROLES["lower bound"], ROLES["diagnostic"]


def curve_of(runs: Runs, updates: int, repeats: int, rng: np.random.Generator, made_of: str) -> Curve:
    """The sigmoid through the solved shares after so many updates, with replicates over resampled settings."""
    z, solved = runs.per_setting(runs.z), runs.solved(updates)
    centre, width = sigmoid.fit(z, solved, runs.seeds)
    replicates = sigmoid.bootstrap(z, solved, runs.seeds, repeats, rng)
    return Curve(
        centre=centre, width=width, replicates=tuple(map(tuple, replicates.round(4).tolist())), made_of=made_of
    )


def centre_interval(curve: Curve) -> tuple[float, float]:
    """Bootstrap percentiles of the centre."""
    low, high = np.quantile(np.array(curve.replicates)[:, 0], [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def keep_curves(curves: Mapping[str, Curve], main: str, outputs: Path) -> None:
    """Writes the curves where the predictor looks for them, with the name of the one that it answers from."""
    write_atomically(outputs / CURVES, (Curves(main=main, curves=dict(curves)).model_dump_json() + "\n").encode())


def outcomes(success: Float[np.ndarray, " r"]) -> dict[str, int]:
    """How many runs end at ceiling, at chance, and anywhere else."""
    ceiling, chance = _ends(success)
    return {"ceiling": int(ceiling.sum()), "chance": int(chance.sum()), "between": int((~ceiling & ~chance).sum())}


def between(runs: Runs, updates: int) -> list[str]:
    """The runs that end neither at ceiling nor at chance, in words."""
    success = runs.at(updates)
    ceiling, chance = _ends(success)
    return [f"z {runs.z[i]:.1f}, success {success[i]:.2f}" for i in np.flatnonzero(~ceiling & ~chance)]


def _ends(success: Float[np.ndarray, " r"]) -> tuple[Bool[np.ndarray, " r"], Bool[np.ndarray, " r"]]:
    return success >= CEILING, (success >= CHANCE[0]) & (success <= CHANCE[1])


def separation(solved: Bool[np.ndarray, " r"], coverage: Float[np.ndarray, " r"]) -> float:
    """AUC: the probability that a solved run has the greater coverage of a pair, ties counting half."""
    with_, without = coverage[solved], coverage[~solved]
    if not len(with_) or not len(without):
        return 0.5
    return float(scipy_stats.mannwhitneyu(with_, without).statistic / (len(with_) * len(without)))


def fair_coin_best(runs: int, episodes: int) -> tuple[float, float]:
    """95% interval of the highest share of heads among so many fair coins tossed so many times each."""
    tails = np.array([(1 - LEVEL) / 2, (1 + LEVEL) / 2]) ** (1 / runs)
    low, high = scipy_stats.binom.ppf(tails, episodes, 0.5) / episodes
    return float(low), float(high)


def majority_edge(runs: Runs, updates: int) -> float:
    """The largest z of which most seeds of a setting are solved; 0 where there is none."""
    solved = runs.solved(updates) > runs.seeds / 2
    return float(runs.per_setting(runs.z)[solved].max(initial=0.0))


def edges(sweep: Mapping[float, Runs], updates: int, repeats: int, rng: np.random.Generator) -> pd.DataFrame:
    """By learning rate: the majority-solved edge, and the centre of the fitted sigmoid with its interval."""
    rows = {}
    for rate, runs in sweep.items():
        curve = curve_of(runs, updates, repeats, rng, "")
        low, high = centre_interval(curve)
        row = {"edge": majority_edge(runs, updates), "centre": curve.centre, "low": low, "high": high}
        rows[rate] = row | outcomes(runs.at(updates))
    return pd.DataFrame(rows).T.rename_axis("SGD rate")


def twins(runs: Runs, updates: int, within: float = 0.03) -> pd.DataFrame:
    """Settings of the shortest and of the longest window whose z differ by at most so large a share."""
    z, window, solved = runs.per_setting(runs.z), runs.per_setting(runs.window), runs.solved(updates)
    rows = []
    for i in np.flatnonzero(window == window.min()):
        for j in np.flatnonzero(window == window.max()):
            if abs(z[i] / z[j] - 1) <= within:
                rows.append((z[i], z[j], f"{solved[i]} of {runs.seeds}", f"{solved[j]} of {runs.seeds}"))
    columns = [f"{what}, N = {n}" for what in ("z", "solved") for n in (window.min(), window.max())]
    return pd.DataFrame(rows, columns=columns).sort_values(columns[0]).reset_index(drop=True)


def _dots(axes: Axes, runs: Runs, shares: Float[np.ndarray, " s"], colour: str, hollow: bool = False) -> None:
    z, window = runs.per_setting(runs.z), runs.per_setting(runs.window)
    for shape, n in zip(SHAPES, np.unique(window), strict=False):
        here = window == n
        face = "white" if hollow else colour
        axes.plot(z[here], shares[here], shape, color=colour, mfc=face, ms=6.5, mew=1, alpha=0.85)


def _curve(axes: Axes, curve: Curve, largest: float, colour: str, label: str) -> None:
    z = np.linspace(0, largest, 400)
    low, high = curve.interval(z)
    axes.fill_between(z, low, high, color=colour, alpha=0.18, lw=0)
    axes.plot(z, curve.solved(z), color=colour, lw=2, label=label)


def generality(arms: Mapping[str, Runs], updates: int, curve: Curve, ours: float, paper: float) -> Figure:
    """Fig. 3a: share of seeds solved against z, a marker a setting; Fig. 3b: final success against coverage."""
    figure = Figure(figsize=(13, 5), layout="constrained")
    left, right = figure.subplots(1, 2)
    gaussian, largest = arms["gaussian"], float(arms["gaussian"].z.max()) * 1.04
    looks = {"categorical": (DIRECT, True, 0.02), "no_signal": (CONTROL, True, -0.02), "gaussian": (OURS, False, 0.0)}
    for name, (colour, hollow, shift) in looks.items():  # shifted a little, so that dots at 0 and 1 can be told apart
        _dots(left, arms[name], arms[name].solved(updates) / arms[name].seeds + shift, colour, hollow)
        left.plot([], [], "o", color=colour, mfc="white" if hollow else colour, label=name.replace("_", "-"))
    for shape, n in zip(SHAPES, np.unique(gaussian.window), strict=False):
        left.plot([], [], shape, color="black", mfc="white", label=f"N = {n}")
    _curve(left, curve, largest, OURS, f"sigmoid, centre {curve.centre:.2f} (paper {paper})")
    left.axvline(ours, color="black", ls=":", lw=1.3)
    left.text(ours + 0.15, 0.5, f"our scene\nz = {ours:.1f}", fontsize=9, va="center")
    left.set(xlabel=r"$z = d\sqrt{N}/\sigma$, known before training", ylabel="share of seeds solved", xlim=(0, largest))
    left.set_title(f"a. Solved: final success of at least {CEILING}", fontsize=11)
    figure.legend(fontsize=9, loc="outside upper left", ncols=7)
    _coverage(right, gaussian, updates)
    return figure


def _coverage(axes: Axes, runs: Runs, updates: int) -> None:
    covered, success = runs.covered(updates), runs.at(updates)
    least = covered[covered > 0].min(initial=0.1) / 3  # where runs that never entered the alternative side are drawn
    for shape, n in zip(SHAPES, np.unique(runs.window), strict=False):
        here = runs.window == n
        axes.plot(np.maximum(covered[here], least), success[here], shape, color=OURS, ms=5, alpha=0.6, label=f"N = {n}")
    chance_line(axes)
    axes.set(xscale="log", xlabel="coverage over all of training (leftmost: none at all)", ylim=(0.4, 1.03))
    axes.set_ylabel("final success (sampled)")
    axes.set_title("b. The same Gaussian runs, a dot a seed", fontsize=11)
    axes.legend(fontsize=9, loc="center left")


def budget_figure(runs: Runs, curves: Mapping[int, Curve], judged: int, paper: float) -> Figure:
    """How the sigmoid, and its centre, move with the training budget; the same runs, looked at on their way."""
    figure = Figure(figsize=(13, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    z = np.linspace(0, runs.z.max(), 400)
    for i, (budget, curve) in enumerate(curves.items()):
        shade = OURS if budget == judged else str(0.75 - 0.6 * i / len(curves))
        left.plot(z, curve.solved(z), color=shade, lw=2.6 if budget == judged else 1.4, label=f"{budget:,} updates")
        right.plot([budget, budget], centre_interval(curve), color=shade, lw=2)
        right.plot(budget, curve.centre, "o", color=shade, ms=8)
    right.axhline(paper, color=ROLES["upper bound"], lw=1.4, label=f"the paper's {paper}")
    left.set(xlabel=r"$z = d\sqrt{N}/\sigma$", ylabel="share of seeds solved (fitted)", xlim=(0, runs.z.max()))
    left.legend(fontsize=8.5)
    right.set(
        xscale="log", xlabel="training budget (updates; log scale)", ylabel="centre of the sigmoid (z)", ylim=(0, None)
    )
    right.set_title("bar: 95% bootstrap over settings; blue: the budget that the study is judged at", fontsize=10)
    right.legend(fontsize=9, loc="upper left")
    return figure


def variants(runs: Mapping[str, Runs], updates: int, repeats: int, rng: np.random.Generator) -> pd.DataFrame:
    """Readings of the task side by side: counts, centre with its interval, R^2 of one curve, and N's p given z."""
    rows = {}
    for name, each in runs.items():
        curve, z, solved = curve_of(each, updates, repeats, rng, name), each.per_setting(each.z), each.solved(updates)
        low, high = centre_interval(curve)
        fitted = sigmoid.explained(z, solved, each.seeds, curve.centre, curve.width)
        centre = {"centre": curve.centre, "low": low, "high": high, "width": curve.width, "R²": fitted}
        rows[name] = outcomes(each.at(updates)) | centre | {"N given z: p": compare(each, updates).p}
    return pd.DataFrame(rows).T


def compare(runs: Runs, updates: int) -> sigmoid.Comparison:
    """Whether the window length adds anything to z."""
    group = np.unique(runs.per_setting(runs.window), return_inverse=True)[1]
    return sigmoid.compare(runs.per_setting(runs.z), group, runs.solved(updates), runs.seeds)


def sgd_figure(sweep: Mapping[float, Runs], table: pd.DataFrame, updates: int) -> Figure:
    """Share of seeds solved against z under plain gradient ascent, a panel a learning rate."""
    figure = Figure(figsize=(14, 3.6), layout="constrained")
    panels = figure.subplots(1, len(sweep), sharey=True, squeeze=False)[0]
    for axes, (rate, runs) in zip(panels, sweep.items(), strict=True):
        _dots(axes, runs, runs.solved(updates) / runs.seeds, OURS)
        axes.axvline(table.edge[rate], color=ROLES["upper bound"], lw=1.6)
        axes.set(xlabel=r"$z = d\sqrt{N}/\sigma$", title=f"rate {rate:g}: edge {table.edge[rate]:.1f}")
    panels[0].set_ylabel("share of seeds solved")
    return figure


def exploration_figure(windows: Sequence[tuple[float, int, float]], episodes: int, rng: np.random.Generator) -> Figure:
    """What exploration looks like before any learning: windows of an untrained policy, for some (d, N, sigma)."""
    figure = Figure(figsize=(13, 3.8), layout="constrained")
    for axes, (d, n, sigma) in zip(figure.subplots(1, len(windows), squeeze=False)[0], windows, strict=True):
        commands = np.clip(sigma * rng.standard_normal((episodes, n)), -1, 1)
        entered = enters_alternative(commands.mean(-1), np.full(episodes, d))
        paths = positions(commands)
        for some, colour in ((~entered, "0.7"), (entered, ROLES["upper bound"])):
            axes.add_collection(LineCollection(paths[some], colors=colour, lw=0.6))
        axes.set_xlim(0, n)
        axes.axhline(d * n, color=OURS, lw=2)
        axes.text(0.3, d * n, "alternative side", color=OURS, va="bottom", fontsize=9)
        z = z_score(d, n, sigma)
        facts = rf"d = {d:.2g}, N = {n}, $\sigma$ = {sigma:g}"
        axes.set_title(f"z = {z:.1f}: {entered.sum()} of {episodes} arrive\n{facts}", fontsize=11)
        axes.set(xlabel="control step", ylabel="steps sideways (full command = 1)")
        axes.set_ylim(-max(d * n, 2 * sigma * n**0.5), 1.15 * max(d * n, 2.5 * sigma * n**0.5))
    return figure


def answers_figure(answers: Mapping[str, Answer]) -> Figure:
    """Tasks on the curve that judges them."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots()
    curve = next(iter(answers.values())).curve
    largest = max(12.0, *(answer.z * 1.08 for answer in answers.values()))
    _curve(axes, curve, largest, OURS, "share of runs that solve it, with its 95% interval")
    for level in (1 - SURE, SURE):
        axes.axhline(level, color="0.6", lw=0.8, ls="--")
    for name, answer in answers.items():
        axes.plot(answer.z, answer.solved, "o", color=ROLES["upper bound"], ms=9, mec="black")
        axes.annotate(
            f"{name}:\n{answer.verdict}",
            (answer.z, answer.solved),
            xytext=(8, 8),
            textcoords="offset points",
            fontsize=9,
        )
    axes.set(xlabel=r"$z = d\sqrt{N}/\sigma$ of the task", ylabel="share of runs that solve it", ylim=(-0.04, 1.16))
    axes.legend(fontsize=9, loc="upper right")
    return figure


def judge_centre(curve: Curve, paper: float) -> dict[str, Any]:
    """The centre as a finding."""
    low, high = centre_interval(curve)
    finding = {"value": curve.centre, "low": low, "high": high, "holds": bool(low <= paper <= high)}
    return finding | {"test": "95% bootstrap interval over settings contains the paper's"}


def judge_collapse(comparison: sigmoid.Comparison, explained: float) -> dict[str, Any]:
    """Whether one curve is enough, as a finding."""
    holds = comparison.p >= ALPHA
    test = f"likelihood ratio of N given z, seeds clustered by setting; R² of the single curve {explained:.3f}"
    return {"value": "one curve" if holds else "N matters", "p": comparison.p, "holds": holds, "test": test}


def judge_control(success: Float[np.ndarray, " r"], episodes: int) -> dict[str, Any]:
    """The highest success of runs whose message tells nothing, as a finding, against as many fair coins."""
    low, high = fair_coin_best(len(success), episodes)
    best = float(success.max())
    own = stats.wilson(round(best * episodes), episodes)
    test = f"95% interval of the highest of {len(success)} fair coins of {episodes:,} tosses: {low:.4f} to {high:.4f}"
    finding = {"value": best, "low": own[0], "high": own[1], "n": len(success)}
    return finding | {"holds": bool(low <= best <= high), "test": test}


def mean_by_setting(runs: Runs, values: Float[np.ndarray, " r"]) -> tuple[float, float, float]:
    """Mean over runs and its 95% Student interval, the settings as the units."""
    means = values.reshape(-1, runs.seeds).mean(1)
    return float(means.mean()), *stats.mean_interval(means)


def hit_edge(windows: float) -> float:
    """The z at which one of so many windows of a policy that does not move arrives with even odds."""
    return float(scipy_stats.norm.isf(-np.expm1(np.log(0.5) / windows)))


def what_moves_the_centre(table: pd.DataFrame, curves: Mapping[int, Curve], paper: float) -> str:
    """What else was tried, in a line for the scoreboard, from `variants` and the curves of all budgets."""
    still, free = table.loc["no drift"], table.loc["not clamped"]
    below = [budget for budget, curve in curves.items() if curve.centre <= paper]
    passed = f"it passes {paper} after {max(below):,} updates" if below else f"it is above {paper} at every budget"
    return (
        f"the centre moves with the budget, which the paper does not print ({passed}); without Adam's walk "
        f"(baseline by message) {still.centre:.2f} [{still.low:.2f}, {still.high:.2f}], {still.ceiling:.0f} at "
        f"ceiling, {still.chance:.0f} at chance; not clamped {free.centre:.2f}, {free.ceiling:.0f} and "
        f"{free.chance:.0f}"
    )
