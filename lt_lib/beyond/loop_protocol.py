"""The closed loop as requests to the run store: two encoders, executors and heads of their own, four eyes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from lt_lib.beyond.loop import drive_behind, look, loop_draws, loop_heads, loop_wires, train_loop_heads
from lt_lib.beyond.senders import frozen
from lt_lib.envs.layout import load_layout
from lt_lib.hardware.matched import train_matched_encoder
from lt_lib.hardware.registration import read_gates
from lt_lib.pixels.crew import arriving_executors
from lt_lib.pixels.episodes import Draws
from lt_lib.pixels.protocol import SEED, PixelProtocol
from lt_lib.settings.base import everywhere, require_known
from lt_lib.settings.beyond import DeciderSizes, DrivingConfig, LoopHeadConfig, LoopSizes, SightConfig
from lt_lib.settings.hardware import MatchedEncoderConfig
from lt_lib.settings.profiles import validated
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore, fetch_by_name

EYES = ("simulated", "even", "bright", "dim")  # the simulator's, and the surrogate camera's in three lights
PLAIN, RANDOMISED = "plain", "randomised"  # encoders, and heads, by the looks of what they were trained on


@dataclass(frozen=True)
class LoopProtocol:
    """The stages at one size, in the scene behind the camera's optics.

    looks  share and texture of the colours that are random in training, as notebook 08 selects them
    """

    sizes: LoopSizes
    heads: DeciderSizes
    matched: MatchedEncoderConfig
    looks: Mapping[str, float]
    pixels: PixelProtocol

    @classmethod
    def of(
        cls,
        loop: Mapping[str, Any],
        readers: Mapping[str, Any],
        matched: Mapping[str, Any],
        candidate: str,
        pixels: PixelProtocol,
    ) -> "LoopProtocol":
        """From a notebook's parameters. Raises UserError for unusable ones.

        candidate  of params/gates/hardware.yaml
        """
        known = read_gates().candidates
        require_known([candidate], known, "candidate", "candidate: ")
        shared = {"device": pixels.sizes.encoder.device}  # in the layout of notebook 08, with friction
        config = everywhere(validated(MatchedEncoderConfig, "matched", dict(matched)), shared)
        sizes, heads = validated(LoopSizes, "loop", dict(loop)), validated(DeciderSizes, "readers", dict(readers))
        return cls(sizes, heads, config, known[candidate], pixels)

    @property
    def store(self) -> RunStore:
        return self.pixels.store

    def encoders(self) -> dict[str, Result]:
        """One trained in random colours, and its twin that was not."""
        configs = {name: self.matched.model_copy(update=self._colours(name)) for name in (RANDOMISED, PLAIN)}
        runs = [Run(train_matched_encoder, config, SEED) for config in configs.values()]
        return dict(zip(configs, self.store.fetch(runs, "matched encoders"), strict=True))

    def executors(self, encoders: Mapping[str, Result]) -> dict[str, Result]:
        """A controller behind each encoder, pretrained in plain simulation; see `pixels.crew`."""
        return arriving_executors(self.store, dict.fromkeys(encoders, self.pixels.sizes), encoders)

    def readers(self, encoders: Mapping[str, Result], executors: Mapping[str, Result]) -> dict[tuple[str, str], Result]:
        """Heads by encoder and by the looks of the simulated frames that they learned from."""
        runs = {}
        for name, encoder in encoders.items():
            bank = self.pixels.episode_bank(encoder, executors[name])
            for looks in (PLAIN, RANDOMISED):
                config = LoopHeadConfig(
                    **self.heads.model_dump(),
                    **self._training(),
                    **self._colours(looks),
                    latency=self.pixels.sizes.latency,
                )
                runs[name, looks] = Run(train_loop_heads, config, SEED, {"bank": bank, "encoder": frozen(encoder)})
        return dict(zip(runs, self.store.fetch(list(runs.values()), "heads"), strict=True))

    def sights(self, encoders: Mapping[str, Result]) -> dict[tuple[str, str], Result]:
        """What scouts send, by encoder and eye; see `beyond.loop.look`."""
        runs = {
            (name, eye): Run(look, self._sight(eye), SEED, {"encoder": frozen(encoder)})
            for name, encoder in encoders.items()
            for eye in EYES
        }
        return dict(zip(runs, self.store.fetch(list(runs.values()), "scouts"), strict=True))

    def driven(self, encoders: Mapping[str, Result], executors: Mapping[str, Result]) -> dict[tuple[str, str], Result]:
        """Outcomes of the navigators' episodes, arrays (draws, slab, route) by encoder and eye."""
        more = self.sizes.model_dump(include={"driven", "shards", "rows", "horizon"})
        more |= {"commit_step": self.pixels.sizes.bank.commit_step}
        runs = {
            ((name, eye), shard): Run(
                drive_behind,
                DrivingConfig(**self._sight(eye).model_dump(exclude={"layout_digest"}) | more),
                shard,
                {"encoder": frozen(encoder), "executor": executors[name]},
            )
            for name, encoder in encoders.items()
            for eye in EYES
            for shard in range(self.sizes.shards)
        }
        shards = fetch_by_name(self.store.fetch, runs, "driving")
        return {
            case: {key: np.concatenate([s[key] for s in parts]) for key in parts[0]} for case, parts in shards.items()
        }

    def routes(self, trained: Result, sight: Result) -> Int[np.ndarray, "heads draws slab"]:
        """The routes that heads choose on what scouts sent."""
        layout, latents = load_layout(self.pixels.layout), sight["latents"]
        draws, placements, _ = latents.shape
        scenes = self.draws().of(np.repeat(np.arange(draws), placements))
        timing = self.pixels.sizes.latency, self.pixels.sizes.bank.commit_step
        wires = loop_wires(layout, latents.reshape(draws * placements, -1), scenes, *timing)
        heads = loop_heads(trained, len(layout.routes))
        return np.stack([head.greedy(wires) for head in heads]).reshape(-1, draws, placements)

    def draws(self) -> Draws:
        """Of the scene, the same behind every eye."""
        return loop_draws(self._sight(EYES[0]))

    def _sight(self, eye: str) -> SightConfig:
        return SightConfig(
            eye=eye, draws=self.sizes.draws, optics=self.sizes.optics, dim=self.sizes.dim, **self._training()
        )

    def _training(self) -> dict[str, str]:
        return {"layout": self.pixels.layout, "device": self.pixels.sizes.encoder.device}

    def _colours(self, name: str) -> dict[str, float]:
        return {key: self.looks[key] if name == RANDOMISED else 0.0 for key in ("colour", "texture")}
