"""Decisions among C corridors, one of them free: the paper's protocol in arenas of `beyond.corridors`, side by side."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Bool

from lt_lib.beyond.corridors import COUNTS
from lt_lib.perception.jepa import train_encoder
from lt_lib.pixels.executor import train_executor
from lt_lib.pixels.protocol import SEED, PixelProtocol
from lt_lib.settings.base import UserError
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore

UNTRAINED = "untrained"


@dataclass(frozen=True)
class DecisionProtocol:
    """The pixel protocol per number of corridors; the executor's training grows with that number."""

    protocols: Mapping[int, PixelProtocol]

    @classmethod
    def of(
        cls, corridors: list[int], pixel_study: Mapping[str, Any], device: str, workers: int | str
    ) -> "DecisionProtocol":
        """From a notebook's parameters. Raises UserError for unusable ones."""
        for count in corridors:
            if count not in COUNTS:
                raise UserError(f"corridors: no arena with {count!r}; expected some of {', '.join(map(str, COUNTS))}")
        return cls({count: _grown(pixel_study, count, device, workers) for count in corridors})

    @property
    def store(self) -> RunStore:
        return next(iter(self.protocols.values())).store

    @property
    def episodes(self) -> int:
        """Of a head's training."""
        return next(iter(self.protocols.values())).sizes.head.episodes

    def encoders(self) -> dict[int, dict[str, Result]]:
        """Per number of corridors, the paper's encoder trained in that arena, and an untrained one."""
        runs = {
            (count, name): Run(train_encoder, protocol.sizes.encoder.model_copy(update=change), SEED)
            for count, protocol in self.protocols.items()
            for name, change in (("ours", {}), (UNTRAINED, {"epochs": 0.0}))
        }
        found: dict[int, dict[str, Result]] = {}
        for (count, name), result in zip(runs, self.store.fetch(list(runs.values()), "encoders"), strict=True):
            found.setdefault(count, {})[name] = result
        return found

    def executors(self, encoders: Mapping[int, Mapping[str, Result]]) -> dict[int, Result]:
        """The low-level controllers, each with a command per corridor."""
        runs = [
            Run(train_executor, protocol.sizes.executor, SEED, {"encoder": encoders[count]["ours"]})
            for count, protocol in self.protocols.items()
        ]
        return dict(zip(self.protocols, self.store.fetch(runs, "executors"), strict=True))

    def banks(self, encoders: Mapping[int, Mapping[str, Result]], executors: Mapping[int, Result]) -> dict[int, Result]:
        """Every outcome of some draws of each arena: arrays (entries, placement, route)."""
        return {
            count: protocol.episode_bank(encoders[count]["ours"], executors[count])
            for count, protocol in self.protocols.items()
        }

    def heads(
        self, seeds: Mapping[str, int], banks: Mapping[int, Result], encoders: Mapping[int, Mapping[str, Result]]
    ) -> dict[int, dict[str, list[Result]]]:
        """Trained heads per number of corridors and message; 'untrained' is the latent of the untrained encoder."""
        contents = {name: count for name, count in seeds.items() if name != UNTRAINED}
        trained = {}
        for count, protocol in self.protocols.items():
            bank, there = banks[count], encoders[count]
            trained[count] = protocol.trained_heads(contents, bank, there["ours"])
            if UNTRAINED in seeds:
                latent = protocol.trained_heads({"latent": seeds[UNTRAINED]}, bank, there[UNTRAINED])
                trained[count][UNTRAINED] = latent["latent"]
        return trained


def ceiling(blocks: Bool[np.ndarray, "placements routes"], bits: int) -> float:
    """The best route optimality that any policy can have on a message of so many bits, placements equally likely.

    A message has 2^bits values, and a policy takes one route at each; the sender, who sees the placement, sends the
    value whose route is free. So it is the best share of placements in which one of 2^bits routes is free.
    """
    routes = blocks.shape[1]
    sets = combinations(range(routes), min(2**bits, routes))
    return max(float((~blocks[:, list(taken)]).any(axis=1).mean()) for taken in sets)


def _grown(pixel_study: Mapping[str, Any], count: int, device: str, workers: int | str) -> PixelProtocol:
    executor = dict(pixel_study["executor"])
    executor["steps"] = executor["steps"] * count // 2
    return PixelProtocol.of({**pixel_study, "executor": executor}, f"corridors_{count}", device, workers)
