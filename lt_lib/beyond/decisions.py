"""Decisions among C corridors: the paper's protocol in arenas of `beyond.corridors`, side by side."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Bool

from lt_lib.envs.layout import load_layout
from lt_lib.perception.jepa import train_encoder
from lt_lib.pixels.crew import arriving_executors
from lt_lib.pixels.protocol import SEED, PixelProtocol
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore

UNTRAINED = "untrained"


@dataclass(frozen=True)
class DecisionProtocol:
    """The pixel protocol per arena; the executor's training grows with the number of corridors."""

    protocols: Mapping[Any, PixelProtocol]

    @classmethod
    def of(
        cls, arenas: Mapping[Any, str], pixel_study: Mapping[str, Any], device: str, workers: int | str
    ) -> "DecisionProtocol":
        """From a notebook's parameters, and layouts by any keys. Raises UserError for unusable ones."""
        return cls({key: _grown(pixel_study, name, device, workers) for key, name in arenas.items()})

    @property
    def store(self) -> RunStore:
        return next(iter(self.protocols.values())).store

    @property
    def episodes(self) -> int:
        """Of a head's training."""
        return next(iter(self.protocols.values())).sizes.head.episodes

    def encoders(self) -> dict[Any, dict[str, Result]]:
        """Per arena, the paper's encoder trained in that arena, and an untrained one."""
        runs = {
            (key, name): Run(train_encoder, protocol.sizes.encoder.model_copy(update=change), SEED)
            for key, protocol in self.protocols.items()
            for name, change in (("ours", {}), (UNTRAINED, {"epochs": 0.0}))
        }
        found: dict[Any, dict[str, Result]] = {}
        for (key, name), result in zip(runs, self.store.fetch(list(runs.values()), "encoders"), strict=True):
            found.setdefault(key, {})[name] = result
        return found

    def executors(self, encoders: Mapping[Any, Mapping[str, Result]]) -> dict[Any, Result]:
        """The low-level controllers, each with a command per corridor; see `pixels.crew`."""
        eyes = {key: encoders[key]["ours"] for key in self.protocols}
        sizes = {key: protocol.sizes for key, protocol in self.protocols.items()}
        return arriving_executors(self.store, sizes, eyes)

    def banks(self, encoders: Mapping[Any, Mapping[str, Result]], executors: Mapping[Any, Result]) -> dict[Any, Result]:
        """Every outcome of some draws of each arena: arrays (entries, placement, route)."""
        return {
            key: protocol.episode_bank(encoders[key]["ours"], executors[key])
            for key, protocol in self.protocols.items()
        }

    def heads(
        self, seeds: Mapping[str, int], banks: Mapping[Any, Result], encoders: Mapping[Any, Mapping[str, Result]]
    ) -> dict[Any, dict[str, list[Result]]]:
        """Trained heads per arena and message; 'untrained' is the latent of the untrained encoder."""
        contents = {name: count for name, count in seeds.items() if name != UNTRAINED}
        trained = {}
        for key, protocol in self.protocols.items():
            bank, there = banks[key], encoders[key]
            trained[key] = protocol.trained_heads(contents, bank, there["ours"])
            if UNTRAINED in seeds:
                latent = protocol.trained_heads({"latent": seeds[UNTRAINED]}, bank, there[UNTRAINED])
                trained[key][UNTRAINED] = latent["latent"]
        return trained


def ceiling(blocks: Bool[np.ndarray, "placements routes"], bits: int) -> float:
    """The best route optimality that any policy can have on a message of so many bits, placements equally likely.

    A message has 2^bits values, and a policy takes one route at each; the sender, who sees the placement, sends the
    value whose route is free. So it is the best share of placements in which one of 2^bits routes is free.
    """
    routes = blocks.shape[1]
    sets = combinations(range(routes), min(2**bits, routes))
    return max(float((~blocks[:, list(taken)]).any(axis=1).mean()) for taken in sets)


def _grown(pixel_study: Mapping[str, Any], name: str, device: str, workers: int | str) -> PixelProtocol:
    protocol = PixelProtocol.of(pixel_study, name, device, workers)
    executor = protocol.sizes.executor
    longer = executor.model_copy(update={"steps": executor.steps * len(load_layout(name).routes) // 2})
    return replace(protocol, sizes=protocol.sizes.model_copy(update={"executor": longer}))
