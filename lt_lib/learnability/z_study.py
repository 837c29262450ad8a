"""The point-mass study: its stacks of runs, and their results as one table of runs.

The unit of training is a stack: all runs of one arm that share a window length.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lt_lib.learnability.predictor import z_score
from lt_lib.learnability.score_function import train_point_mass
from lt_lib.settings.base import UserError
from lt_lib.settings.learnability import UPDATES_PER_LOOK, PointMassConfig
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore

SEED = 0  # of the first run of every setting
CEILING = 0.95  # least final success of a solved run
CONTROL = 4  # times as many episodes for the control, whose highest success the paper prints to three digits
CHANCE = (0.45, 0.55)  # final success of a run at chance


class Runs(NamedTuple):
    """R runs of one arm; the seeds of a setting are adjacent."""

    window: Int[np.ndarray, " r"]
    d: Float[np.ndarray, " r"]
    sigma: Float[np.ndarray, " r"]
    success: Float[np.ndarray, "r b"]  # after each of `budgets` updates
    coverage: Float[np.ndarray, "r blocks"]  # over each UPDATES_PER_LOOK updates
    budgets: tuple[int, ...]
    seeds: int  # per setting

    @property
    def z(self) -> Float[np.ndarray, " r"]:
        return z_score(self.d, self.window, self.sigma)

    def at(self, updates: int) -> Float[np.ndarray, " r"]:
        """Success of every run after `updates` updates, one of the budgets."""
        return self.success[:, self.budgets.index(updates)]

    def solved(self, updates: int) -> Int[np.ndarray, " s"]:
        """Number of seeds at ceiling per setting."""
        return (self.at(updates) >= CEILING).reshape(-1, self.seeds).sum(1)

    def covered(self, updates: int) -> Float[np.ndarray, " r"]:
        """Share of the training episodes in the first `updates` updates that entered the alternative side."""
        return self.coverage[:, : updates // UPDATES_PER_LOOK].mean(1)

    @property
    def largest_z(self) -> float:
        return float(self.z.max())

    def per_setting(self, values: np.ndarray) -> np.ndarray:
        """The value that the seeds of a setting share."""
        return values[:: self.seeds]


class Tried(NamedTuple):
    """The Gaussian arm for one choice of what the paper does not print, under Adam and under plain gradient ascent."""

    adam: Runs
    slow: Runs  # at the smallest rate
    fast: Runs  # at the largest


@dataclass(frozen=True)
class ZStudy:
    """The study at one size.

    config   what all stacks share
    windows  lengths N, control steps
    looks    increasing budgets at which the Gaussian runs are measured; they contain config.budgets[-1], at which the
             study is judged. Without a schedule, a longer run is identical at each budget to the run that ends there

    Raises UserError for looks that do not increase or lack that budget.
    """

    store: RunStore
    config: PointMassConfig
    windows: Sequence[int]
    looks: Sequence[int]

    def __post_init__(self) -> None:
        if self.updates not in self.looks or list(self.looks) != sorted(set(self.looks)):
            raise UserError(f"looks: must increase and contain the study's {self.updates}, got {list(self.looks)}")

    @property
    def updates(self) -> int:
        return self.config.budgets[-1]

    def parts(self, rates: Sequence[float]) -> dict[str, PointMassConfig]:
        """The study's parts by name; each is trained at every window length.

        gaussian, categorical, no_signal  the three arms
        unclamped   Gaussian runs with unbounded commands
        no_drift    the same, with one baseline per message: no gradient while a message's episodes all end alike
        sgd <rate>  Gaussian runs under plain gradient ascent
        """
        particular = {
            "gaussian": {"budgets": tuple(self.looks)},
            "categorical": {"arm": "categorical"},
            "no_signal": {"arm": "no_signal", "evaluation": CONTROL * self.config.evaluation},
            "unclamped": {"arm": "unclamped"},
            "no_drift": {"arm": "unclamped", "baseline": "message"},
            **{f"sgd {rate:g}": {"optimiser": "sgd", "lr": rate} for rate in rates},
        }
        return {name: self.config.model_copy(update=changes) for name, changes in particular.items()}

    def all_runs(self, rates: Sequence[float]) -> dict[str, Runs]:
        """Every run of the study, by part."""
        parts = self.parts(rates)
        results = self.store.fetch([Run(train_point_mass, s, SEED) for s in self._stacks(parts)], "point-mass runs")
        each = _batched(results, len(self.windows))
        return {name: self._joined(part, own) for (name, part), own in zip(parts.items(), each, strict=True)}

    def tried(
        self, grids: Sequence[tuple[float, ...]], scores: Sequence[str], rates: Sequence[float]
    ) -> dict[tuple[int, str], Tried]:
        """Gaussian runs at every look, by the number of a grid of d and by how a window's score is taken."""
        arms = {"adam": {}} | {rate: {"optimiser": "sgd", "lr": rate} for rate in (min(rates), max(rates))}
        parts = {
            (i, score, arm): self.config.model_copy(
                update={"distances": tuple(grid), "score": score, "budgets": tuple(self.looks)} | change
            )
            for i, grid in enumerate(grids)
            for score in scores
            for arm, change in arms.items()
        }
        results = self.store.fetch([Run(train_point_mass, s, SEED) for s in self._stacks(parts)], "what is not printed")
        each = _batched(results, len(self.windows))
        runs = {name: self._joined(part, own) for (name, part), own in zip(parts.items(), each, strict=True)}
        return {(i, score): Tried(*(runs[i, score, arm] for arm in arms)) for i, score, _ in runs}

    def stacking_gain(self, rates: Sequence[float], singles: int, updates: int) -> tuple[float, float]:
        """CPU seconds of the whole study, stacked and one run after another.

        Each stack is timed over its first `updates` updates, alternating with `singles` of its runs alone.
        """
        stacked, alone = 0.0, 0.0
        for stack in self._stacks(self.parts(rates)):
            share = updates / stack.budgets[-1]
            looks = max(round(stack.evaluation * len(stack.budgets) * share), 1)
            short = stack.model_copy(update={"budgets": (updates,), "evaluation": looks})
            grid = list(product(stack.distances, stack.sigmas))
            chosen = [grid[i] for i in np.linspace(0, len(grid) - 1, singles).astype(int)]
            each = [short.model_copy(update={"distances": (d,), "sigmas": (s,), "seeds": 1}) for d, s in chosen]
            stacked += _seconds([short]) / share
            alone += _seconds(each) / share * len(grid) * stack.seeds / singles
        return stacked, alone

    def _stacks(self, parts: Mapping[str, PointMassConfig]) -> list[PointMassConfig]:
        return [part.model_copy(update={"window": n}) for part, n in product(parts.values(), self.windows)]

    def _joined(self, config: PointMassConfig, stacks: Sequence[Result]) -> Runs:
        window = np.repeat(self.windows, [len(stack["d"]) for stack in stacks])
        columns = (np.concatenate([stack[name] for stack in stacks]) for name in ("d", "sigma", "success", "coverage"))
        return Runs(window, *columns, config.budgets, config.seeds)


def _batched(items: Sequence[Result], size: int) -> list[Sequence[Result]]:
    return [items[i : i + size] for i in range(0, len(items), size)]


def _seconds(configs: Sequence[PointMassConfig]) -> float:
    start = time.process_time()
    for config in configs:
        train_point_mass(config, SEED, report=lambda _: None)
    return time.process_time() - start
