"""Short stretches of the project's real work, as notebook 10 times and profiles them."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from lt_lib.hardware.matched import train_matched_encoder
from lt_lib.learnability.score_function import train_point_mass
from lt_lib.pixels.episodes import roll_bank
from lt_lib.pixels.protocol import PixelProtocol
from lt_lib.pixels.redraw import SCENES, train_redrawn_head
from lt_lib.pixels.route import train_head
from lt_lib.settings.hardware import MatchedEncoderConfig
from lt_lib.settings.learnability import PointMassConfig
from lt_lib.settings.velocity import NavigatorConfig
from lt_lib.speed.turns import taking_turns
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore
from lt_lib.velocity.navigator import train_navigator


def unheard(_: float) -> None:
    """Ignores a run's progress reports."""


class BankCost(NamedTuple):
    """Processor seconds of training route heads on the episode bank and in the live simulation."""

    bank: float  # the whole bank, every outcome of every draw
    head: float  # one head trained on the bank
    live: float  # one head trained live, one draw per episode

    def heads(self, count: int) -> tuple[float, float]:
        """Seconds for `count` heads: on the bank, whose own price is included, and live."""
        return self.bank + count * self.head, count * self.live


def bank_against_live(
    protocol: PixelProtocol, bank: Result, encoder: Result, executor: Result, episodes: int
) -> BankCost:
    """Cost of a head either way, scaled up from `episodes` live episodes and a bank of as many draws."""
    frozen = {"encoder": encoder, "executor": executor}
    scenes = {name: bank[name] for name in SCENES}
    rolled = protocol.sizes.bank.model_copy(update={"entries": episodes})
    live = {"every": 0, "content": "latent", "credit": "episode", "episodes": episodes, "precision": rolled.precision}
    once = protocol.sizes.redraw.model_copy(update=live)
    calls = {
        "bank": lambda: roll_bank(rolled, 0, report=unheard, **frozen),
        "head": lambda: train_head(protocol.sizes.head, 0, report=unheard, bank=bank, encoder=encoder),
        "live": lambda: train_redrawn_head(once, 0, report=unheard, scenes=scenes, **frozen),
    }
    seconds = taking_turns(calls, 1)
    whole_bank = seconds["bank"] * protocol.sizes.bank.entries * protocol.sizes.shards / episodes
    return BankCost(whole_bank, seconds["head"], seconds["live"] * protocol.sizes.head.episodes / episodes)


def seconds_by_workers(config: PointMassConfig, runs: int, workers: Sequence[int]) -> dict[int, float]:
    """Wall-clock seconds of the same `runs`, computed from scratch, by number of workers.

    The workers have started before the clock does.
    """
    several = [Run(train_point_mass, config, seed * config.seeds) for seed in range(runs + max(workers))]
    seconds = {}
    for count in workers:
        with TemporaryDirectory() as folder:
            store = RunStore(Path(folder), count)
            store.fetch(several[runs : runs + count], "workers start")
            start = time.perf_counter()
            store.fetch(several[:runs], "timed runs")
            seconds[count] = time.perf_counter() - start
    return seconds


def training_stretches(
    protocol: PixelProtocol, bank: Result, encoder: Result, executor: Result, episodes: int, steps: int, frames: int
) -> dict[str, Callable[[], dict]]:
    """Stretches of the most expensive trainings, by stage.

    episodes  of a head that draws its route at every step
    steps     of a navigator's control
    frames    of a matched encoder's training set
    """
    scenes = {name: bank[name] for name in SCENES}
    every = {"every": 1, "content": "latent", "credit": "episode", "episodes": episodes}
    head = protocol.sizes.redraw.model_copy(update=every)
    navigator = NavigatorConfig(steps=steps, layout=protocol.layout, precision=protocol.sizes.redraw.precision)
    matched = MatchedEncoderConfig(frames=frames, texture=0.1)
    return {
        "train_redrawn_head": lambda: train_redrawn_head(
            head, 0, report=unheard, scenes=scenes, encoder=encoder, executor=executor
        ),
        "train_navigator": lambda: train_navigator(navigator, 0, report=unheard, encoder=encoder),
        "train_matched_encoder": lambda: train_matched_encoder(matched, 0, report=unheard),
    }
