"""The controls, stage by stage, as requests to the run store: senders, ladder, variance split, gridworld's twin.

The paper's encoder, executor, episode bank, channel and head are held fixed; what the scout sends is what varies.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lt_lib.beyond.grid import GRID_SENDERS, train_grid_end_to_end, train_grid_reader
from lt_lib.beyond.ladder import label
from lt_lib.beyond.readers import train_end_to_end, train_readers
from lt_lib.beyond.senders import SENDERS, frozen, measure_sender
from lt_lib.beyond.variance import perfect_bank
from lt_lib.envs.layout import load_layout
from lt_lib.gridworld.protocol import GridProtocol
from lt_lib.perception.gates import Measured
from lt_lib.perception.jepa import train_encoder
from lt_lib.perception.weights import save_frozen
from lt_lib.pixels.crew import with_looks
from lt_lib.pixels.executor import train_executor
from lt_lib.pixels.protocol import SEED, PixelProtocol
from lt_lib.settings.base import everywhere, require_known
from lt_lib.settings.beyond import (
    ControlsConfig,
    EndToEndConfig,
    GridReaderConfig,
    PatchSenderConfig,
    ReaderConfig,
    Rung,
    SenderConfig,
)
from lt_lib.settings.perception import EncoderConfig
from lt_lib.settings.profiles import validated
from lt_lib.store.run import Result, Run
from lt_lib.store.runs import RunStore, fetch_by_name

PAPER_S, END_TO_END, SILENT = "jepa", "end_to_end", "silence"
DRAWN = ("untrained", "random")  # senders of which there are several, since nothing but their seed makes them
RETRAINED = ("jepa", "contrastive", "autoencoder", "pca", "supervised")  # also trained on frames in random colours
# Rungs that a prediction speaks of
HERE, NOISE, ANYWHERE, RECOLOURED = "the paper's scene", "noise 0.6", "anywhere", "appearance 1 + anywhere"
Heads = dict[tuple[str, str], list[Result]]  # what heads learned, by sender and rung


@dataclass(frozen=True)
class ControlProtocol:
    """The stages at one size."""

    sizes: ControlsConfig
    pixels: PixelProtocol
    grid: GridProtocol

    @classmethod
    def of(cls, controls: Mapping[str, Any], pixels: PixelProtocol, gridworld: Mapping[str, Any]) -> "ControlProtocol":
        """From a notebook's parameters. Raises UserError for unusable ones."""
        sizes = validated(ControlsConfig, "controls", dict(controls))
        shared = {"layout": pixels.layout, "device": pixels.sizes.encoder.device}
        sizes = sizes.model_copy(update={name: everywhere(each, shared) for name, each in sizes})
        return cls(sizes, pixels, GridProtocol.of(gridworld, pixels.store.workers))

    @property
    def store(self) -> RunStore:
        return self.pixels.store

    def train_all(self) -> None:
        """Trains encoder and senders side by side, for whoever asks for them later."""
        ours = [] if self.pixels.weights else [Run(train_encoder, self.pixels.sizes.encoder, SEED)]
        plain = self._runs([name for name in SENDERS if name != PAPER_S], self.sizes.sender)
        self.store.fetch([*ours, *plain.values(), *self._runs(RETRAINED, self._recoloured).values()], "senders")

    def train_beside_executor(self, encoder: Result) -> None:
        """Trains the executor, which takes one core for minutes, and beside it what else needs no bank."""
        driver = Run(train_executor, with_looks(self.pixels.sizes.executor), SEED, {"encoder": encoder})
        others = [*self._layout_encoders().values(), *self._patch_senders().values()]
        self.store.fetch(others if self.pixels.weights else [driver, *others], "executor, and encoders of other scenes")

    def senders(self, encoder: Result) -> dict[str, list[Result]]:
        """Every frozen sender by name, several of those that are drawn; the JEPA sender is the paper's encoder.

        encoder  the paper's
        """
        names = [name for name in SENDERS if name != PAPER_S]
        return {PAPER_S: [frozen(encoder)]} | self._trained(names, self.sizes.sender)

    def recoloured_senders(self) -> dict[str, list[Result]]:
        """Some senders trained on frames whose floor and walls have random colours."""
        return self._trained(RETRAINED, self._recoloured)

    @property
    def _recoloured(self) -> SenderConfig:
        return self.sizes.recoloured.model_copy(update={"colour": self.sizes.colour})

    def _runs(self, names: Sequence[str], config: SenderConfig) -> dict[tuple[str, int], Run]:
        return {
            (name, seed): Run(
                SENDERS[name].train, config.model_copy(update={"kind": name, **SENDERS[name].changes}), seed
            )
            for name in names
            for seed in range(self.sizes.drawn if name in DRAWN else 1)
        }

    def _trained(self, names: Sequence[str], config: SenderConfig) -> dict[str, list[Result]]:
        trained = fetch_by_name(self.store.fetch, self._runs(names, config), "senders")
        return {name: [frozen(each) for each in results] for name, results in trained.items()}

    def gate_reports(self, senders: Mapping[str, list[Result]], colour: float = 0.0) -> dict[str, list[Result]]:
        """Probes and rank of every sender, on frames that look like its training's; see `perception.gates.Measured`."""
        config = self.sizes.gates.model_copy(update={"colour": colour})
        runs = {
            (name, seed): Run(measure_sender, config, SEED, {"sender": sender})
            for name, several in senders.items()
            for seed, sender in enumerate(several)
        }
        return fetch_by_name(self.store.fetch, runs, "gates of senders")

    def save(self, senders: Mapping[str, list[Result]], reports: Mapping[str, list[Result]], folder: Path) -> None:
        """Saves senders that were trained as sender_<name>, their gates' measures beside them.

        What nothing but a seed makes is made again by its function, and the paper's encoder has a file of its own.
        """
        layout = load_layout(self.pixels.layout)
        for name in [name for name in senders if name not in (*DRAWN, SILENT, PAPER_S)]:
            facts = {"gates": {field: reports[name][0][field] for field in Measured._fields}}
            save_frozen(folder, f"sender_{name}", senders[name][0], layout, facts)

    def read(self, senders: Mapping[str, list[Result]], rungs: Sequence[Rung], bank: Result) -> Heads:
        """Heads that read each sender on each rung; one result per sender of a name."""
        runs = {
            (name, label(rung), seed): Run(
                train_readers,
                ReaderConfig(**self._reading(), sender=f"{name} {seed}", rung=rung),
                SEED,
                {"bank": bank, "sender": sender},
            )
            for name, several in senders.items()
            for rung in rungs
            for seed, sender in enumerate(several)
        }
        return _by_sender_and_rung(runs, self.store.fetch(list(runs.values()), "readers"))

    def learned_with_the_head(self, rungs: Sequence[Rung], bank: Result) -> Heads:
        """Senders that learn with their head, on each rung."""
        runs = {
            (END_TO_END, label(rung), seed): Run(
                train_end_to_end,
                EndToEndConfig(**self._reading(), sender=END_TO_END, rung=rung),
                seed,
                {"bank": bank},
            )
            for rung in rungs
            for seed in range(self.sizes.end_to_end)
        }
        return _by_sender_and_rung(runs, self.store.fetch(list(runs.values()), "end to end"))

    def varied(self, rung: Rung) -> np.ndarray:
        """Route optimality (layouts, encoders, heads) on one rung of JEPA encoders trained in other arenas."""
        sizes, encoders = self.sizes.variance, self._layout_encoders()
        trained_there = self.store.fetch(list(encoders.values()), "encoders of layouts")
        reading = self._reading() | {"heads": sizes.heads, "repeats": 1}
        banks = {layout: perfect_bank(layout, sizes.draws) for layout in sizes.layouts}
        runs = [
            Run(
                train_readers,
                ReaderConfig(**reading | {"layout": layout}, sender=f"jepa {seed}", rung=rung),
                SEED,
                {"bank": banks[layout], "sender": frozen(encoder)},
            )
            for (layout, seed), encoder in zip(encoders, trained_there, strict=True)
        ]
        greedy = [result["greedy"].mean(axis=1) for result in self.store.fetch(runs, "readers in other layouts")]
        return np.reshape(greedy, (len(sizes.layouts), sizes.encoders, sizes.heads))

    def _layout_encoders(self) -> dict[tuple[str, int], Run]:
        sizes = self.sizes.variance
        trained = self.sizes.sender.model_copy(update={"frames": sizes.frames})
        return {
            (layout, seed): Run(train_encoder, _plain(trained, layout), seed)
            for layout in sizes.layouts
            for seed in range(sizes.encoders)
        }

    def _patch_senders(self) -> dict[str, Run]:
        shared = {name: getattr(self.grid.encoder, name) for name in ("layout", "frames", "rollout", "epochs")}
        return {
            name: Run(sender.train, PatchSenderConfig(kind=name, **shared | dict(sender.changes)), SEED)
            for name, sender in GRID_SENDERS.items()
        }

    def twin(self) -> dict[str, list[Result]]:
        """Receivers of the gridworld that read each sender there, and one that learns with its sender."""
        grid, encoder = self.grid, self.grid.encoder_weights()
        trained = self.store.fetch(list(self._patch_senders().values()), "patch senders")
        senders = dict(zip(GRID_SENDERS, trained, strict=True))
        eyes, policy = {"encoder": grid.frozen(encoder)}, grid.grid.model_dump(exclude={"layout_digest"})
        runs = {
            (name, seed): Run(
                train_grid_reader,
                GridReaderConfig(**policy, sender=name),
                seed,
                eyes | {"sender": frozen(sender)},
            )
            for name, sender in senders.items()
            for seed in range(self.sizes.grid_seeds)
        } | {
            (END_TO_END, seed): Run(train_grid_end_to_end, grid.grid, seed, eyes)
            for seed in range(self.sizes.grid_seeds)
        }
        return fetch_by_name(self.store.fetch, runs, "gridworld receivers")

    def _reading(self) -> dict[str, Any]:
        head = self.pixels.sizes.head.model_dump(exclude={"layout_digest", "content", "wire"})
        return head | {name: getattr(self.sizes, name) for name in ("repeats", "heads", "share")}


def read_rungs(rungs: Sequence[Mapping[str, Any]]) -> list[Rung]:
    """The rungs of a notebook's parameter. Raises UserError for an unusable one, or if one lacks that is predicted."""
    ladder = validated(list[Rung], "rungs", list(rungs))
    require_known(
        (HERE, NOISE, ANYWHERE, RECOLOURED), [label(rung) for rung in ladder], "rung", "rungs: predicted but "
    )
    return ladder


def _plain(config: SenderConfig, layout: str) -> EncoderConfig:
    """Stage 1's own settings among a sender's, in another layout."""
    fields = {name: getattr(config, name) for name in EncoderConfig.model_fields}
    return EncoderConfig(**fields | {"layout": layout})


def _by_sender_and_rung(runs: Mapping[tuple[str, str, int], Run], results: Sequence[Result]) -> Heads:
    heads: Heads = {}
    for (name, rung, _), result in zip(runs, results, strict=True):
        heads.setdefault((name, rung), []).append(result)
    return heads
