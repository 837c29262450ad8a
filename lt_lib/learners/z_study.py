"""The point-mass study: which stacks of runs it is made of, and their results as one table of runs.

The unit of training is a stack: all runs of one arm that share a window length.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lt_lib.learners.predictor import z_score
from lt_lib.learners.score_function import train_point_mass
from lt_lib.params import BLOCK, PointMassConfig, UserError
from lt_lib.runs import Result, Run, RunStore

SEED = 0  # of the first run of every setting
CEILING = 0.95  # final success from which a run counts as solved
CHANCE = (0.45, 0.55)  # final success of a run at chance


class Runs(NamedTuple):
    """R runs of one arm; the seeds of a setting stand beside each other."""

    window: Int[np.ndarray, " r"]
    d: Float[np.ndarray, " r"]
    sigma: Float[np.ndarray, " r"]
    success: Float[np.ndarray, "r b"]  # after each of `budgets` updates
    coverage: Float[np.ndarray, "r blocks"]  # of every BLOCK updates
    budgets: tuple[int, ...]
    seeds: int  # a setting

    @property
    def z(self) -> Float[np.ndarray, " r"]:
        return z_score(self.d, self.window, self.sigma)

    def at(self, updates: int) -> Float[np.ndarray, " r"]:
        """Success of every run after so many updates, one of the budgets."""
        return self.success[:, self.budgets.index(updates)]

    def solved(self, updates: int) -> Int[np.ndarray, " s"]:
        """How many seeds of every setting are at ceiling."""
        return (self.at(updates) >= CEILING).reshape(-1, self.seeds).sum(1)

    def covered(self, updates: int) -> Float[np.ndarray, " r"]:
        """Share of the training episodes of the first so many updates that entered the alternative side."""
        return self.coverage[:, : updates // BLOCK].mean(1)

    @property
    def largest_z(self) -> float:
        return float(self.z.max())

    def per_setting(self, values: np.ndarray) -> np.ndarray:
        """The value that the seeds of a setting share."""
        return values[:: self.seeds]


@dataclass(frozen=True)
class ZStudy:
    """The study at one size.

    config   what all stacks share
    windows  lengths N, control steps
    looks    budgets at which the Gaussian runs are looked at; they increase and contain config.budgets[-1], which the
             study is judged at. Without a schedule, a run that goes on is at each budget the run that ended there

    Raises UserError where they do not.
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

    def all_runs(self, rates: Sequence[float], step_evaluation: int) -> dict[str, Runs]:
        """Every run of the study, by what is particular to it.

        gaussian, categorical, no_signal  the three arms
        steps, clamped                    Gaussian runs with every single step drawn, and with each clamped to full
                                          command; measured over `step_evaluation` episodes
        no_drift                          Gaussian runs with a baseline for each message: no gradient while the
                                          episodes of a message all end alike
        sgd <rate>                        Gaussian runs under plain gradient ascent
        """
        by_steps = {"evaluation": step_evaluation}
        particular = {
            "gaussian": {"budgets": tuple(self.looks)},
            "categorical": {"arm": "categorical"},
            "no_signal": {"arm": "no_signal"},
            "steps": {"arm": "steps", **by_steps},
            "clamped": {"arm": "clamped", **by_steps},
            "no_drift": {"baseline": "message"},
            **{f"sgd {rate:g}": {"optimiser": "sgd", "lr": rate} for rate in rates},
        }
        configs = {name: self.config.model_copy(update=changes) for name, changes in particular.items()}
        stacks = [c.model_copy(update={"window": n}) for c, n in product(configs.values(), self.windows)]
        results = self.store.fetch([Run(train_point_mass, stack, SEED) for stack in stacks], "point-mass runs")
        each = _batched(results, len(self.windows))
        return {name: self._joined(c, own) for (name, c), own in zip(configs.items(), each, strict=True)}

    def _joined(self, config: PointMassConfig, stacks: Sequence[Result]) -> Runs:
        window = np.repeat(self.windows, [len(stack["d"]) for stack in stacks])
        columns = (np.concatenate([stack[name] for stack in stacks]) for name in ("d", "sigma", "success", "coverage"))
        return Runs(window, *columns, config.budgets, config.seeds)


def stacking_gain(config: PointMassConfig, singles: int, rounds: int = 3) -> tuple[float, float]:
    """Processor seconds a run, stacked and one by one; `singles` runs of the stack stand for all. Medians of rounds."""
    grid = list(product(config.distances, config.sigmas))
    chosen = [grid[i] for i in np.linspace(0, len(grid) - 1, singles).astype(int)]
    alone = [config.model_copy(update={"distances": (d,), "sigmas": (s,), "seeds": 1}) for d, s in chosen]
    stacked, single = [], []
    for _ in range(rounds):
        stacked.append(_seconds([config]) / (len(grid) * config.seeds))
        single.append(_seconds(alone) / singles)
    return float(np.median(stacked)), float(np.median(single))


def _batched(items: Sequence[Result], size: int) -> list[Sequence[Result]]:
    return [items[i : i + size] for i in range(0, len(items), size)]


def _seconds(configs: Sequence[PointMassConfig]) -> float:
    start = time.process_time()
    for config in configs:
        train_point_mass(config, SEED, report=lambda _: None)
    return time.process_time() - start
