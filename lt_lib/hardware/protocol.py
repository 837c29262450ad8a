"""The hardware protocol, stage by stage (Section Hardware): what notebook 08 asks the run store for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from lt_lib.envs.layout import load_layout
from lt_lib.hardware.matched import measure_matched_gates, train_matched_encoder
from lt_lib.hardware.probe import CameraTransfer, transfer
from lt_lib.hardware.real_frames import read_sessions
from lt_lib.hardware.sessions import Session, film_session, film_sweep, session_of, simulated_session
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.perception.frames import random_rollouts
from lt_lib.perception.gates import encode
from lt_lib.perception.pictures import PictureEncoder
from lt_lib.pixels.episodes import obedience, roll_bank
from lt_lib.pixels.executor import FrozenExecutor, train_executor
from lt_lib.settings.base import ROOT, UserError, everywhere
from lt_lib.settings.devices import computing_device
from lt_lib.settings.hardware import (
    HardwareGates,
    MatchedEncoderConfig,
    MatchedGateConfig,
    RailsConfig,
    SessionsConfig,
    SweepConfig,
)
from lt_lib.settings.pixels import BankConfig, ExecutorConfig
from lt_lib.settings.profiles import validated
from lt_lib.settings.streams import Stream
from lt_lib.store.files import runs_folder
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore

SEED = 0  # of candidates and executor; the encoders of the spread have seeds of their own
FILMED = {"refit": 1, "validation": 2, "live": 3}  # seeds of the surrogate's sessions
SIMULATED, SWEPT = 4, 5  # seeds of the simulated bench and of the sweeps
PLAIN = "no randomisation"  # the twin whose floor and walls are never recoloured


@dataclass(frozen=True)
class HardwareProtocol:
    """The stages at one size; `folder` holds real frames, None means the surrogate camera."""

    store: RunStore
    gates: HardwareGates
    matched: MatchedEncoderConfig
    cheap: MatchedEncoderConfig
    checks: MatchedGateConfig
    sessions: SessionsConfig
    executor: ExecutorConfig
    rails: RailsConfig
    simulated: int  # placements of the simulated bench, of each answer
    folder: Path | None

    @classmethod
    def of(
        cls, gates: HardwareGates, workers: int | str, device: str, frames: str, simulated: int, **sections: Mapping
    ):
        """From a notebook's parameters: `sections` are dicts for matched, cheap, checks, sessions, executor, rails."""
        kinds = {
            "matched": MatchedEncoderConfig,
            "cheap": MatchedEncoderConfig,
            "checks": MatchedGateConfig,
            "executor": ExecutorConfig,
            "rails": RailsConfig,
        }
        shared = {"device": computing_device(device), "layout": "matched"}
        given = {name: validated(kind, name, sections[name]) for name, kind in kinds.items()}
        configs = {name: everywhere(each, shared) for name, each in given.items()}
        return cls(
            RunStore(runs_folder(), workers),
            gates,
            **configs,
            sessions=validated(SessionsConfig, "sessions", sections["sessions"]),
            simulated=simulated,
            folder=ROOT / frames if frames else None,
        )

    def config(self, name: str) -> MatchedEncoderConfig:
        """The training of a candidate, or of the plain twin."""
        looks = {"colour": 0.0, "texture": 0.0} if name == PLAIN else self.gates.candidates[name]
        return self.matched.model_copy(update=looks)

    def encoders(self) -> dict[str, Result]:
        """The candidates and the plain twin, all of one size and one seed."""
        names = [*self.gates.candidates, PLAIN]
        runs = [Run(train_matched_encoder, self.config(name), SEED) for name in names]
        return dict(zip(names, self.store.fetch(runs, "matched encoders"), strict=True))

    def gate_reports(self, encoders: Mapping[str, Result]) -> dict[str, Result]:
        """What each encoder shows at the gates; see `perception.matched.Shown`."""
        runs = [Run(measure_matched_gates, self.checks, SEED, {"encoder": encoder}) for encoder in encoders.values()]
        return dict(zip(encoders, self.store.fetch(runs, "matched gates"), strict=True))

    def simulated_bench(self, name: str, part: int = 0) -> Session:
        """Labelled frames of the bench in simulation, in the appearances of a candidate; each part is fresh."""
        bench = self.sessions.live.model_copy(update={"hazard": self.simulated, "clear": self.simulated})
        return simulated_session(bench, self.config(name), SIMULATED + 100 * part)

    def surrogate(self) -> dict[str, Session]:
        """The three sessions with the surrogate camera."""
        return {name: session_of(result) for name, result in self._films().items()}

    def filmed(self) -> dict[str, Session]:
        """The three sessions to decode: those of the folder of real frames, else the surrogate's."""
        return read_sessions(self.folder) if self.folder else self.surrogate()

    def views(self) -> dict[str, np.ndarray]:
        """Some whole frames of each of the surrogate's sessions."""
        return {name: result["views"] for name, result in self._films().items()}

    def _films(self) -> dict[str, Result]:
        runs = [Run(film_session, getattr(self.sessions, name), seed) for name, seed in FILMED.items()]
        return dict(zip(FILMED, self.store.fetch(runs, "surrogate sessions"), strict=True))

    def transfers(
        self, encoders: Mapping[str, Result], looks: str, sessions: Mapping[str, Session]
    ) -> dict[str, CameraTransfer]:
        """Both probes of each encoder; all of them were trained in the appearances of the candidate `looks`."""
        simulated = self.simulated_bench(looks)
        return {
            name: transfer(PictureEncoder(encoder, self.matched.device), simulated, sessions)
            for name, encoder in encoders.items()
        }

    def sweeps(self, effects: Sequence[str], sizes: Mapping[str, int]) -> dict[str, Result]:
        """The surrogate's frames at rising strengths of each effect; see `perception.sessions.film_sweep`."""
        live = self.sessions.live.model_dump(exclude={"hazard", "clear", "shots", "frames", "layout_digest"})
        runs = [Run(film_sweep, SweepConfig(**live | dict(sizes), effect=effect), SWEPT) for effect in effects]
        return dict(zip(effects, self.store.fetch(runs, "camera effects"), strict=True))

    def ordinary(self, effects: Sequence[str]) -> dict[str, float]:
        """The strength of each effect in the live session."""
        strengths = self.sessions.live.optics.model_dump() | self.sessions.live.bench.model_dump()
        return {effect: float(strengths[effect]) for effect in effects}

    def after_selection(
        self, candidate: str, encoder: Result, seeds: int, lengths: Sequence[int]
    ) -> tuple[Result, list[Result]]:
        """The executor behind the selected encoder, and encoders of the cheaper size in its appearances, one per seed.

        They are computed side by side, since neither waits for the other.

        lengths  control steps, increasing, after which the executor's weights are kept; `executor.steps` is one of them

        Raises UserError for other lengths.
        """
        update = self.executor.envs * self.executor.rollout
        if self.executor.steps not in lengths or any(length % update for length in lengths):
            raise UserError(
                f"lengths: expected multiples of {update} control steps, executor.steps {self.executor.steps} among "
                f"them, got {list(lengths)}"
            )
        config = self.cheap.model_copy(update=self.gates.candidates[candidate])
        driving = self.executor.model_copy(update={"steps": max(lengths), "looks": tuple(lengths)})
        runs = [Run(train_executor, driving, SEED, {"encoder": encoder})]
        runs += [Run(train_matched_encoder, config, seed) for seed in range(seeds)]
        driver, *cheap = self.store.fetch(runs, "executor and encoder seeds")
        return driver, cheap

    def obedience(self, encoder: Result, drivers: Mapping[int, Result]) -> dict[int, float]:
        """Share of episodes from the spawn, under either placement and route, that enter that corridor, by length."""
        config = BankConfig(layout=self.executor.layout, device=self.executor.device, entries=self.rails.draws)
        runs = [Run(roll_bank, config, SEED, {"encoder": encoder, "executor": driver}) for driver in drivers.values()]
        return dict(zip(drivers, map(obedience, self.store.fetch(runs, "obedience")), strict=True))


def past_the_rails(config: RailsConfig, encoder: Result, executor: Result) -> Float[np.ndarray, "routes axes"]:
    """Share of an executor's action components beyond +-1 before clipping, on frames of held-out rollouts."""
    device = config.device
    rng = Stream.RAILS.generator(SEED)
    rollouts = random_rollouts(load_layout(config.layout), config.rollouts, config.length, rng)
    latents = torch.from_numpy(encode(FrozenEncoder(encoder, device), rollouts.frames)).flatten(0, 1).to(device)
    driver = FrozenExecutor(executor, device)
    actions = [driver.mean_action(latents, np.full(len(latents), route)) for route in range(driver.routes)]
    return (np.abs(actions) > 1).mean(axis=1)
