"""Messages that travel by radio: in few bits, lost, late, out of reach, noisy; and heads that read what arrives.

The scenes, the outcomes of the routes and the head are the paper's (Sections Route head, Broadcast and anchor). The
navigator decides at the commit step, or waits for a message as long as its patience lasts.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lt_lib.beyond.codes import KINDS, Messages, View
from lt_lib.beyond.deciders import learned
from lt_lib.beyond.senders import frozen
from lt_lib.comm.channel import ANCHOR, Channel
from lt_lib.comm.loss import GilbertElliott
from lt_lib.comm.route_head import RouteHead
from lt_lib.envs.arena import HORIZON
from lt_lib.envs.camera import FastCamera, colours
from lt_lib.envs.layout import load_layout
from lt_lib.perception.pictures import PictureEncoder
from lt_lib.pixels.episodes import Draws, Outcomes, held_out_draws
from lt_lib.pixels.protocol import SEED, PixelProtocol
from lt_lib.settings.beyond import CodeConfig, DeciderSizes, LinkConfig, RadioConfig
from lt_lib.settings.profiles import validated
from lt_lib.settings.streams import Stream
from lt_lib.store.run import Result, Run
from lt_lib.store.states import restored, state_of

TOGETHER = 1_024  # links simulated at a time, which bounds the memory of raw messages in flight


class Scenes(NamedTuple):
    """n scenes of a bank: the draw, the placement of the slab, and what each route brings, (n, routes)."""

    draws: Draws
    slab: Int[np.ndarray, " n"]
    outcomes: Outcomes


class Heard(NamedTuple):
    """What reaches the navigators when they decide, and how many control steps past the commit step that is."""

    wires: Float[Tensor, "n w"]
    waited: Int[np.ndarray, " n"]


def draw_radio_scenes(bank: Mapping[str, Any], n: int, cut: int, rng: np.random.Generator) -> Scenes:
    """n scenes: `cut` of the bank's held-out draws, then others of its training draws, the slab placed at random."""
    held_out = held_out_draws(bank)
    entry = np.concatenate([rng.integers(0, held_out, cut), rng.integers(held_out, len(bank["spawn"]), n - cut)])
    slab = rng.integers(0, bank["success"].shape[1], n)
    outcomes = Outcomes(*(bank[name][entry, slab] for name in Outcomes._fields))
    return Scenes(Draws(bank["spawn"][entry], bank["scout"][entry]), slab, outcomes)


def heard(
    link: LinkConfig,
    radius: float,
    commit_step: int,
    contents: Float[Tensor, "n c"],
    draws: Draws,
    rng: np.random.Generator,
) -> Heard:
    """Sends every scout's message at every control step, and listens.

    A navigator decides at the commit step, or, if it has patience, on the first message after that, or without one.

    radius  metres, of the layout; a link's own reach comes before it
    """
    n, width = contents.shape
    lost = GilbertElliott((n,), link.loss, link.memory, rng)
    corrupt = None if link.noise is None else partial(noisy, decibel=link.noise, rng=rng)
    channel = Channel((n,), width, link.reach or radius, link.latency, corrupt, lost)
    scout, navigator = draws.scout[:, :2], draws.spawn[:, :2]
    wires, waited = torch.zeros(n, ANCHOR + width), np.full(n, link.patience)
    undecided = np.ones(n, bool)
    for step in range(commit_step + link.patience + 1):
        channel.send(step, contents, scout)
        arrived = channel.receive(step, navigator)
        if step >= commit_step:
            now = undecided & (arrived != 0).any(dim=1).numpy()
            wires[now], waited[now] = arrived[now], step - commit_step
            undecided &= ~now
    return Heard(wires, waited)


def noisy(wire: Float[Tensor, "b w"], decibel: float, rng: np.random.Generator) -> Float[Tensor, "b w"]:
    """White noise on the content, whose power is so many decibels above it; the anchor is the receiver's own."""
    content = wire[:, ANCHOR:]
    deviation = content.square().mean().sqrt() * 10 ** (-decibel / 20)
    return torch.cat(
        [wire[:, :ANCHOR], content + deviation * torch.from_numpy(rng.standard_normal(content.shape)).float()], dim=1
    )


def after_waiting(outcomes: Outcomes, waited: Int[np.ndarray, " n"]) -> Outcomes:
    """The outcomes of routes taken so many control steps later; what would end past the horizon fails."""
    length = outcomes.length + waited[:, None]
    return outcomes._replace(success=outcomes.success & (length <= HORIZON), length=np.minimum(length, HORIZON))


class Received(NamedTuple):
    """What heads have to go by in scenes, and what their choice brings."""

    wires: Float[Tensor, "n w"]
    bits: Int[np.ndarray, " n"]
    waited: Int[np.ndarray, " n"]
    free: Bool[np.ndarray, "n routes"]
    outcomes: Outcomes


def received(
    config: RadioConfig, scenes: Scenes, commit_step: int, sender: Mapping[str, np.ndarray], rng: np.random.Generator
) -> Received:
    """What travels over the configured link, in the configured code, in every scene."""
    layout, draws = load_layout(config.layout), scenes.draws
    pictures = colours(FastCamera(layout).frames(draws.scout, scenes.slab, draws.spawn[:, :2]))
    view = View(layout, PictureEncoder(sender, config.device), pictures, scenes.slab)
    said: Messages = KINDS[config.code.kind](config.code, view)
    parts = []
    for start in range(0, len(scenes.slab), TOGETHER):
        part = slice(start, start + TOGETHER)
        there = Draws(draws.spawn[part], draws.scout[part])
        parts.append(heard(config.link, layout.communication_radius, commit_step, said.contents[part], there, rng))
    waited = np.concatenate([part.waited for part in parts])
    outcomes = after_waiting(scenes.outcomes, waited)
    return Received(torch.cat([part.wires for part in parts]), said.bits, waited, ~layout.blocks[scenes.slab], outcomes)


def train_radio(
    config: RadioConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    bank: Mapping[str, np.ndarray],
    sender: Mapping[str, np.ndarray],
) -> dict:
    """Heads of `config.heads` seeds that are trained over the configured link, and the entries of `chosen`.

    "<head>.*"  weights of each
    """
    there, cut = _there(config, bank, sender)
    rewards, width, routes = there.outcomes.returns, there.wires.shape[1], there.free.shape[1]
    heads = []
    for head in range(config.heads):
        rng = Stream.READER.generator(head, "radio", repr(config.code), repr(config.link))
        make = partial(RouteHead, width, routes)
        heads.append(learned(config, make, there.wires[cut:], rewards[cut:], rng)[0])
        report((head + 1) / config.heads)
    states = {name: value for i, head in enumerate(heads) for name, value in state_of(head, str(i)).items()}
    return states | chosen(heads, there, cut)


def evaluate_radio(
    config: RadioConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    bank: Mapping[str, np.ndarray],
    sender: Mapping[str, np.ndarray],
    heads: Mapping[str, np.ndarray],
) -> dict:
    """The entries of `chosen` for heads of `train_radio` that were trained over another link."""
    there, cut = _there(config, bank, sender)
    width, routes = there.wires.shape[1], there.free.shape[1]
    return chosen([restored(RouteHead(width, routes), heads, str(i)) for i in range(config.heads)], there, cut)


def chosen(heads: list[RouteHead], there: Received, cut: int) -> dict[str, np.ndarray]:
    """Greedy choices in the first `cut` scenes, which no head was trained on.

    "greedy", "success", "length"  (heads, scenes): the free corridor, the goal reached, control steps
    "bits", "waited"               (scenes,) of the message;  "silent" (scenes,) whether none arrived
    """
    routes = np.stack([head.greedy(there.wires[:cut]) for head in heads])
    at = np.arange(cut), routes
    return {
        "greedy": there.free[at],
        "success": there.outcomes.success[at],
        "length": there.outcomes.length[at],
        "bits": there.bits[:cut],
        "waited": there.waited[:cut],
        "silent": ~(there.wires[:cut] != 0).any(dim=1).numpy(),
    }


def _there(config: RadioConfig, bank: Mapping[str, Any], sender: Mapping[str, np.ndarray]) -> tuple[Received, int]:
    cut = int(config.scenes * config.held_out)
    scenes = draw_radio_scenes(bank, config.scenes, cut, Stream.RADIO.generator(SEED, "scenes"))  # the same for all
    rng = Stream.RADIO.generator(SEED, repr(config.code), repr(config.link))
    return received(config, scenes, int(bank["commit_step"]), sender, rng), cut


@dataclass(frozen=True)
class RadioProtocol:
    """Heads behind the paper's frozen encoder and bank, one code and one link after another."""

    sizes: DeciderSizes
    pixels: PixelProtocol

    @classmethod
    def of(cls, radio: Mapping[str, Any], pixels: PixelProtocol) -> "RadioProtocol":
        """From a notebook's parameter. Raises UserError for an unusable one."""
        return cls(validated(DeciderSizes, "radio", dict(radio)), pixels)

    def trained(self, cases: Mapping[Any, Mapping], inputs: Mapping[str, Result], what: str) -> dict[Any, Result]:
        """Heads trained in each case, `{"code": ..., "link": ...}` as far as it differs from the paper's."""
        runs = self._trainings(cases, inputs)
        return dict(zip(cases, self.pixels.store.fetch(runs, what), strict=True))

    def tested(
        self, cases: Mapping[Any, Mapping], heads: Result, inputs: Mapping[str, Result], what: str
    ) -> dict[Any, Result]:
        """Frozen heads in each case."""
        runs = self._tests(cases, heads, inputs)
        return dict(zip(cases, self.pixels.store.fetch(runs, what), strict=True))

    def both_ways(
        self, cases: Mapping[Any, Mapping], heads: Result, inputs: Mapping[str, Result], what: str
    ) -> tuple[dict[Any, Result], dict[Any, Result]]:
        """Heads trained in each case, and frozen heads that were trained intact; side by side."""
        runs = self._trainings(cases, inputs)
        results = self.pixels.store.fetch([*runs, *self._tests(cases, heads, inputs)], what)
        trained, tested = results[: len(cases)], results[len(cases) :]
        return dict(zip(cases, trained, strict=True)), dict(zip(cases, tested, strict=True))

    def _trainings(self, cases: Mapping[Any, Mapping], inputs: Mapping[str, Result]) -> list[Run]:
        return [Run(train_radio, self._config(case), SEED, inputs) for case in cases.values()]

    def _tests(self, cases: Mapping[Any, Mapping], heads: Result, inputs: Mapping[str, Result]) -> list[Run]:
        inputs = {**inputs, "heads": {name: value for name, value in heads.items() if name[0].isdigit()}}
        return [Run(evaluate_radio, self._config(case), SEED, inputs) for case in cases.values()]

    def inputs(self) -> dict[str, Result]:
        """The paper's bank and what its encoder needs to send."""
        encoder = self.pixels.encoder_weights()
        return {
            "bank": self.pixels.episode_bank(encoder, self.pixels.executor_weights(encoder)),
            "sender": frozen(encoder),
        }

    def _config(self, case: Mapping) -> RadioConfig:
        given = {"code": CodeConfig(**case.get("code", {})), "link": LinkConfig(**case.get("link", {}))}
        device = self.pixels.sizes.encoder.device
        return RadioConfig(**self.sizes.model_dump(), layout=self.pixels.layout, device=device, **given)
