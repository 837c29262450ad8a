"""The content-controlled protocol, stage by stage (Sections Overview, Setup), as requests to the run store.

Everything but the message is held fixed: one frozen encoder, one frozen executor, one bank of episodes, one head.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from lt_lib.comm.channel import CORRUPTIONS
from lt_lib.comm.messages import CONDITIONS
from lt_lib.envs.layout import load_layout
from lt_lib.perception.gates import Measured, measure_gates, passes, require_gates
from lt_lib.perception.jepa import train_encoder
from lt_lib.perception.weights import facts_of, load_frozen, save_frozen
from lt_lib.pixels.crew import arriving_executors
from lt_lib.pixels.episodes import roll_bank
from lt_lib.pixels.redraw import REDRAWS, SCENES, train_redrawn_head
from lt_lib.pixels.route import evaluate_head, train_head
from lt_lib.settings.base import ROOT, everywhere, require_known
from lt_lib.settings.devices import computing_device
from lt_lib.settings.pixels import EvaluationConfig, HeadConfig, PixelsConfig, RedrawConfig
from lt_lib.settings.profiles import validated
from lt_lib.store.files import runs_folder
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore, fetch_by_name
from lt_lib.store.states import only

SEED = 0  # of the one encoder and the one executor, as in the paper; heads have seeds of their own
TRIES = 3  # encoders at most, a seed each, where the gates fail


@dataclass(frozen=True)
class PixelProtocol:
    """The stages at one size.

    weights  folder of the frozen encoder and executor, or None to train them
    """

    store: RunStore
    sizes: PixelsConfig
    layout: str
    weights: Path | None = None

    @classmethod
    def of(
        cls, pixel_study: Mapping[str, Any], layout: str, device: str, workers: int | str, weights: str = ""
    ) -> "PixelProtocol":
        """From a notebook's parameters. Raises UserError for unusable ones."""
        sizes = validated(PixelsConfig, "pixel_study", pixel_study)
        shared = {"layout": layout, "device": computing_device(device), "latency": sizes.latency}
        sizes = sizes.model_copy(update={name: everywhere(each, shared) for name, each in sizes})
        return cls(RunStore(runs_folder(), workers), sizes, layout, ROOT / weights if weights else None)

    def encoders(self) -> dict[str, Result]:
        """Our encoder and those it must beat at the gates: an untrained one, and one trained by prediction alone."""
        alone = {"variance": 0.0, "covariance": 0.0, "reconstruction": 0.0}
        configs = {
            "ours": self.sizes.encoder,
            "untrained": self.sizes.encoder.model_copy(update={"epochs": 0.0}),
            "prediction alone": self.sizes.encoder.model_copy(update=alone),
        }
        if self.weights:
            del configs["ours"]
        runs = [Run(train_encoder, config, SEED) for config in configs.values()]
        trained = dict(zip(configs, self.store.fetch(runs, "encoders"), strict=True))
        return {"ours": self.tried_encoders()[-1][0]} | {name: trained[name] for name in trained if name != "ours"}

    def gate_reports(self, encoders: Mapping[str, Result]) -> dict[str, Result]:
        """Probes and rank of checkpoints; see `perception.gates.Measured`."""
        runs = [Run(measure_gates, self.sizes.probe, SEED, {"encoder": encoder}) for encoder in encoders.values()]
        return dict(zip(encoders, self.store.fetch(runs, "freeze gates"), strict=True))

    def tried_encoders(self) -> list[tuple[Result, Result]]:
        """Checkpoints and their gate reports, seed after seed, up to the first that passes; at most `TRIES` of them."""
        tried = []
        for seed in range(SEED, SEED + TRIES):
            trained = self._kept("encoder") if self.weights else self._trained_encoder(seed)
            tried.append((trained, self.gate_reports({"ours": trained})["ours"]))
            if self.weights or passes(tried[-1][1], self.sizes.gates):
                break
        return tried

    def encoder_weights(self) -> Result:
        """Stage 1: E and P after passing the gates. Raises GateError if none of the tried ones does."""
        trained, report = self.tried_encoders()[-1]
        require_gates(report, self.sizes.gates)
        return trained

    def _trained_encoder(self, seed: int) -> Result:
        return self.store.fetch([Run(train_encoder, self.sizes.encoder, seed)], "encoder")[0]

    def _kept(self, kind: str) -> Result:
        return load_frozen(self.weights, kind, load_layout(self.layout))

    def executor_weights(self, encoder: Result) -> Result:
        """The low-level controller, pretrained behind the frozen encoder; see `pixels.crew`."""
        if self.weights:
            return self._kept("executor")
        return arriving_executors(self.store, {self.layout: self.sizes}, {self.layout: encoder})[self.layout]

    def encoder_facts(self, report: Result) -> dict:
        """What is stored with the frozen encoder: its training settings and its gate measurements."""
        if self.weights:
            return facts_of(self.weights, "encoder")
        return {"settings": self.sizes.encoder.model_dump(), "gates": {name: report[name] for name in Measured._fields}}

    def save_executor(self, executor: Result, folder: Path) -> Path:
        """Saves the frozen executor beside the frozen encoder."""
        facts = facts_of(self.weights, "executor") if self.weights else {"settings": self.sizes.executor.model_dump()}
        return save_frozen(folder, "executor", executor, load_layout(self.layout), facts)

    def episode_bank(self, encoder: Result, executor: Result) -> Result:
        """Every outcome of `shards` times `bank.entries` draws of the scene; arrays (entries, slab, route)."""
        inputs = {"encoder": encoder, "executor": executor}
        shards = self.store.fetch(
            [Run(roll_bank, self.sizes.bank, shard, inputs) for shard in range(self.sizes.shards)], "episode bank"
        )
        arrays = [name for name, value in shards[0].items() if isinstance(value, np.ndarray)]
        return shards[0] | {name: np.concatenate([shard[name] for shard in shards]) for name in arrays}

    def trained_heads(self, seeds: Mapping[str, int], bank: Result, encoder: Result) -> dict[str, list[Result]]:
        """Stage 2: the given number of seeds per condition of Table I, all with the same settings.

        Rows of REDRAWS among the names are left to `redrawn_heads`.
        """
        runs = {
            (name, seed): Run(train_head, self._head(name), seed, {"bank": bank, "encoder": encoder})
            for name, count in seeds.items()
            if name not in REDRAWS
            for seed in range(count)
        }
        return fetch_by_name(self.store.fetch, runs, "route heads")

    def with_minibatch(self, minibatch: int) -> "PixelProtocol":
        """The same protocol with another minibatch of the route head, episodes."""
        head = self.sizes.head.model_copy(update={"minibatch": minibatch})
        return replace(self, sizes=self.sizes.model_copy(update={"head": head}))

    def without_anchor(self, seeds: int, bank: Result, encoder: Result) -> list[Result]:
        """Heads that get the latent without its anchor, which the paper calls spatially unusable."""
        config = self._head("latent").model_copy(update={"wire": "anchor_zeroed"})
        runs = [Run(train_head, config, seed, {"bank": bank, "encoder": encoder}) for seed in range(seeds)]
        return self.store.fetch(runs, "heads without the anchor")

    def redrawn_heads(
        self, seeds: Mapping[str, int], bank: Result, encoder: Result, executor: Result
    ) -> dict[str, list[Result]]:
        """The given number of seeds per row of REDRAWS, trained live on the bank's scenes, and one seed each of

        no bonus   the latent drawn at every step, without the entropy bonus that all rows share
        float32    two batches with one draw per episode, which equal the bank's episode by episode
        """
        scenes = {name: bank[name] for name in SCENES}
        inputs = {"scenes": scenes, "encoder": encoder, "executor": executor}
        rows = {(name, seed): self._redrawn(name) for name in seeds if name in REDRAWS for seed in range(seeds[name])}
        every, once = self._redrawn("k1"), self._redrawn("k0")
        unrewarded = every.ppo.model_copy(update={"entropy": 0.0})
        configs = {
            ("no bonus", SEED): every.model_copy(update={"ppo": unrewarded}),
            **rows,
            ("float32", SEED): once.model_copy(update={"precision": "float32", "episodes": 2 * once.batch}),
        }
        longest_first = sorted(configs, key=lambda key: configs[key].every or inf)
        runs = {key: Run(train_redrawn_head, configs[key], key[1], inputs) for key in longest_first}
        drawn = fetch_by_name(self.store.fetch, runs, "redrawn heads")
        return {name: drawn[name] for name, _ in configs}

    def corrupted(
        self, name: str, seed: int, head: Result, episodes: int, bank: Result, encoder: Result
    ) -> dict[str, Result]:
        """The frozen trained head of a seed under every wire condition of Table IV, greedily."""
        inputs = {"head": only(head, "head"), "bank": bank, "encoder": encoder}
        shared = {key: getattr(self.sizes.head, key) for key in ("layout", "device", "latency")}
        shared |= {"content": CONDITIONS[name].content, "episodes": episodes}
        configs = [EvaluationConfig(wire=wire, **shared) for wire in CORRUPTIONS]
        runs = [Run(evaluate_head, config, seed, inputs) for config in configs]
        return dict(zip(CORRUPTIONS, self.store.fetch(runs, f"corruption of {name}"), strict=True))

    def _head(self, name: str) -> HeadConfig:
        require_known([name], CONDITIONS, "message condition")
        condition = CONDITIONS[name]
        return self.sizes.head.model_copy(update={"content": condition.content, "wire": condition.wire})

    def _redrawn(self, name: str) -> RedrawConfig:
        row = REDRAWS[name]
        same = {key: getattr(self.sizes.head, key) for key in ("minibatch", "lr")}
        varied = {"content": row.content, "every": row.every, "credit": row.credit}
        return self.sizes.redraw.model_copy(update=same | varied)
