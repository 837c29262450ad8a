"""The content-controlled protocol in the gridworld, stage by stage (Section Gridworld): one encoder, one receiver."""

from collections.abc import Mapping
from dataclasses import dataclass

from lt_lib.comm.channel import CORRUPTIONS
from lt_lib.gridworld.episodes import evaluate_grid
from lt_lib.gridworld.mappo import train_grid
from lt_lib.gridworld.patch_gates import measure_patch_gates, require_patch_gates
from lt_lib.gridworld.patches import train_patch_encoder
from lt_lib.gridworld.views import rescaled
from lt_lib.gridworld.wires import GRID_CONTENTS
from lt_lib.settings.base import everywhere, require_known
from lt_lib.settings.gridworld import (
    GridConfig,
    GridEvaluationConfig,
    GridworldConfig,
    PatchEncoderConfig,
    PatchGateConfig,
    PatchGates,
    Scaled,
)
from lt_lib.settings.profiles import validated
from lt_lib.store.files import runs_folder
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore, fetch_by_name
from lt_lib.store.states import only

SEED = 0  # of the one encoder; receivers have seeds of their own
OURS, WITHOUT, UNTRAINED, ALONE = "ours", "without reconstruction", "untrained", "prediction alone"


@dataclass(frozen=True)
class GridProtocol:
    """The stages on one layout, at one size."""

    store: RunStore
    encoder: PatchEncoderConfig
    gates: PatchGates
    grid: GridConfig
    scaled: Scaled = "each"

    @classmethod
    def of(cls, gridworld: Mapping, workers: int | str) -> "GridProtocol":
        """From a notebook's parameters."""
        section = validated(GridworldConfig, "gridworld", dict(gridworld))
        there = {"layout": section.layout, "latency": section.latency}
        encoder, policy = (everywhere(each, there) for each in (section.encoder, section.policy))
        return cls(RunStore(runs_folder(), workers), encoder, section.gates, policy, section.scaled)

    def encoders(self) -> dict[str, Result]:
        """Ours, the ablation of the auxiliary that the paper calls necessary, and what ours must beat at the gates."""
        changes = {
            OURS: {},
            WITHOUT: {"reconstruction": 0.0},
            ALONE: {"reconstruction": 0.0, "variance": 0.0, "covariance": 0.0},
            UNTRAINED: {"epochs": 0.0},
        }
        runs = [Run(train_patch_encoder, self.encoder.model_copy(update=change), SEED) for change in changes.values()]
        return dict(zip(changes, self.store.fetch(runs, "patch encoders"), strict=True))

    def gate_reports(self, encoders: Mapping[str, Result]) -> dict[str, Result]:
        """Probe, share and rank of checkpoints; see `perception.patch_gates.PatchesMeasured`."""
        config = PatchGateConfig(layout=self.encoder.layout)
        runs = [Run(measure_patch_gates, config, SEED, {"encoder": encoder}) for encoder in encoders.values()]
        return dict(zip(encoders, self.store.fetch(runs, "patch gates"), strict=True))

    def encoder_weights(self) -> Result:
        """Stage 1: E and P once they have passed the gates. Raises GateError if they do not."""
        trained = self.trained_encoder()
        require_patch_gates(self.gate_reports({OURS: trained})[OURS], self.gates)
        return trained

    def trained_encoder(self) -> Result:
        """Stage 1 without its gates."""
        return self.store.fetch([Run(train_patch_encoder, self.encoder, SEED)], "patch encoder")[0]

    def trained(self, seeds: Mapping[str, int], encoder: Result) -> dict[str, list[Result]]:
        """Stage 2: so many seeds of each content, all with the same settings. Raises UserError for an unknown one."""
        require_known(seeds, GRID_CONTENTS, "message content")
        return self._fetch({content: (content, count, encoder) for content, count in seeds.items()})

    def ablated(self, encoders: Mapping[str, Result], seeds: int) -> dict[str, list[Result]]:
        """Stage 2 for the latent of each of several encoders."""
        return self._fetch({name: ("latent", seeds, encoder) for name, encoder in encoders.items()})

    def variants(
        self, changes: Mapping[str, Mapping[str, object]], encoder: Result, seeds: int
    ) -> dict[str, list[Result]]:
        """Stage 2 with settings that the paper's rows share changed: so many seeds of each, by name."""
        runs = {
            (name, seed): Run(
                train_grid, self.grid.model_copy(update=dict(change)), seed, {"encoder": self.frozen(encoder)}
            )
            for name, change in changes.items()
            for seed in range(seeds)
        }
        return fetch_by_name(self.store.fetch, runs, "gridworld variants")

    def _fetch(self, wanted: Mapping[str, tuple[str, int, Result]]) -> dict[str, list[Result]]:
        runs = {
            (name, seed): Run(train_grid, self._trained_on(content), seed, {"encoder": self.frozen(encoder)})
            for name, (content, count, encoder) in wanted.items()
            for seed in range(count)
        }
        return fetch_by_name(self.store.fetch, runs, "gridworld policies")

    def corrupted(
        self, policies: Mapping[str, list[Result]], episodes: int, encoder: Result
    ) -> dict[str, list[dict[str, Result]]]:
        """Every frozen policy under every wire condition: {content: [{wire: result} per seed]}."""
        shared = {"layout": self.grid.layout, "latency": self.grid.latency}
        runs = {
            (content, seed, wire): Run(
                evaluate_grid,
                GridEvaluationConfig(content=content, wire=wire, episodes=episodes, **shared),
                seed,
                {"policy": only(policy, "actor"), "encoder": self.frozen(encoder)},
            )
            for content, trained in policies.items()
            for seed, policy in enumerate(trained)
            for wire in CORRUPTIONS
        }
        results = dict(zip(runs, self.store.fetch(list(runs.values()), "gridworld corruption"), strict=True))
        return {
            content: [{wire: results[content, seed, wire] for wire in CORRUPTIONS} for seed in range(len(trained))]
            for content, trained in policies.items()
        }

    def _trained_on(self, content: str) -> GridConfig:
        return self.grid.model_copy(update={"content": content})

    def frozen(self, encoder: Result) -> Result:
        """Weights, and the latent's normalisation as policies get it: how the training went does not concern them."""
        weights = {name: value for name, value in encoder.items() if not name.startswith("loss.")}
        return dict(rescaled(weights, self.scaled))
