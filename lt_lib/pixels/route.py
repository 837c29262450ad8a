"""Stage 2: the route head learns from the team's episode return alone (Sections Route head, Rendered pixels).

The head sees only the wire and the executor cannot see it, so the route has one possible source of information. The
one draw per episode is credited with the whole return; the head is never told whether it matched the slab.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lt_lib import ppo
from lt_lib.comm.channel import ANCHOR, WIRES, Channel
from lt_lib.comm.messages import CONTENTS, Sender
from lt_lib.comm.route_head import Chooser, RouteHead
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import Layout, load_layout
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.pixels.episodes import Outcomes, held_out_draws
from lt_lib.settings.pixels import EvaluationConfig, HeadConfig
from lt_lib.settings.streams import Stream
from lt_lib.store.states import restored, state_of

CHUNK = 1024  # frames encoded at a time


class Bank(NamedTuple):
    """The content and the outcome of every draw of the scene, and where the robots stand in it (metres)."""

    contents: Float[Tensor, "e slab c"]
    scout: Float[np.ndarray, "e 2"]
    navigator: Float[np.ndarray, "e 2"]  # at the commit step, until which it waits at its spawn
    outcomes: Outcomes  # (E, slab, route)
    blocks: Bool[np.ndarray, "slab route"]  # whether a placement of the slabs blocks a route
    commit_step: int

    def take(self, entries: slice | Bool[np.ndarray, " e"]) -> "Bank":
        kept = (values[entries] for values in self[:3])
        outcomes = Outcomes(*(values[entries] for values in self.outcomes))
        return Bank(*kept, outcomes, self.blocks, self.commit_step)

    def wires(
        self, channel: Channel, entry: Int[np.ndarray, " b"], slab: Int[np.ndarray, " b"]
    ) -> Float[Tensor, "b w"]:
        """What reaches the navigators at the commit step of the given draws and slab placements."""
        sent = self.contents[entry, slab], self.scout[entry]
        return committed_wires(channel, self.commit_step, *sent, self.navigator[entry])


def committed_wires(
    channel: Channel,
    commit_step: int,
    content: Float[Tensor, "b c"],
    scout: Float[np.ndarray, "b 2"],
    navigator: Float[np.ndarray, "b 2"],
) -> Float[Tensor, "b w"]:
    """What reaches waiting navigators at the commit step from stationary scouts that send from the first step."""
    sent_at, rows = commit_step - channel.latency, np.arange(len(content))
    if sent_at >= 0:
        channel.send(sent_at, content, scout, rows)
    return channel.receive(commit_step, navigator, rows)


def sent_contents(
    layout: Layout,
    encoder: FrozenEncoder,
    content: str,
    spawn: Float[np.ndarray, "e 3"],
    scout: Float[np.ndarray, "e 3"],
) -> Float[Tensor, "e slab c"]:
    """What the scout sends under each slab placement while the navigator waits at its spawn."""
    camera, contents = FastCamera(layout), []
    for slab in range(len(layout.placements)):
        slabs = np.full(len(spawn), slab)
        frames = camera.frames(scout, slabs, spawn[:, :2])
        parts = []
        for i in range(0, len(spawn), CHUNK):
            part = slice(i, i + CHUNK)
            still = np.zeros((len(scout[part]), 2))
            parts.append(CONTENTS[content](Sender(layout, encoder, frames[part], scout[part], still, slabs[part])))
        contents.append(torch.cat(parts))
    return torch.stack(contents, dim=1)


def sent_wires(
    layout: Layout,
    encoder: FrozenEncoder,
    content: str,
    spawn: Float[np.ndarray, "e 3"],
    scout: Float[np.ndarray, "e 3"],
    commit_step: int,
) -> Float[Tensor, "e slab w"]:
    """What reaches the navigator at the commit step of each draw of the scene, under each slab placement."""
    contents = sent_contents(layout, encoder, content, spawn, scout)  # (e, slab, c)
    slabs = contents.shape[1]
    channel = Channel((slabs * len(spawn),), contents.shape[-1], layout.communication_radius)
    places = (np.repeat(poses[:, :2], slabs, axis=0) for poses in (scout, spawn))  # (e * slab, 2)
    return committed_wires(channel, commit_step, contents.flatten(0, 1), *places).unflatten(0, (-1, slabs))


def read_bank(
    config: HeadConfig | EvaluationConfig, bank: Mapping[str, np.ndarray], encoder: Mapping[str, np.ndarray]
) -> tuple[Bank, Bank]:
    """The bank's training draws and its held-out draws, with the configured content."""
    layout, frozen = load_layout(config.layout), FrozenEncoder(encoder, config.device)
    spawn, scout = bank["spawn"], bank["scout"]
    contents = sent_contents(layout, frozen, config.content, spawn, scout)
    outcomes = Outcomes(**{name: bank[name] for name in Outcomes._fields})
    whole = Bank(contents, scout[:, :2], spawn[:, :2], outcomes, layout.blocks, bank["commit_step"])
    held_out = held_out_draws(bank)
    return whole.take(slice(held_out, None)), whole.take(slice(held_out))


def channel_of(config: HeadConfig | EvaluationConfig, senders: int, width: int, rng: np.random.Generator) -> Channel:
    """The channel with the configured latency and corruption."""
    radius = load_layout(config.layout).communication_radius
    return Channel((senders,), width, radius, config.latency, lambda wire: WIRES[config.wire](wire, rng))


def train_head(
    config: HeadConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    bank: Mapping[str, np.ndarray],
    encoder: Mapping[str, np.ndarray],
) -> dict:
    """Trains one head; returns its weights, the outcome of every training episode and a greedy evaluation.

    "head.*"           weights
    "optimal", "success", "contacts", "length", "route" (episodes,) of the head's sampled choices, in order
    "entropy" (updates,) nats, "value_loss" (updates,)
    "greedy.*"         the same four and "route" of greedy choices over the held-out draws, the slab placed at random
    """
    rng = Stream.HEAD.generator(seed, config.content, config.wire)
    training, held_out = read_bank(config, bank, encoder)
    width = training.contents.shape[-1]
    head = ppo.built(lambda: RouteHead(ANCHOR + width, training.blocks.shape[1]), rng)
    optimiser = torch.optim.Adam(head.parameters(), lr=config.lr, eps=1e-5, fused=True)
    course = learn(head, optimiser, training, channel_of(config, config.batch, width, rng), config, rng, report)
    greedy = evaluate(head, held_out, channel_of(config, len(held_out.contents), width, rng), rng)
    return state_of(head, "head") | course | {f"greedy.{name}": values for name, values in greedy.items()}


def learn(
    head: Chooser,
    optimiser: torch.optim.Optimizer,
    training: Bank,
    channel: Channel,
    config: HeadConfig,
    rng: np.random.Generator,
    report: Callable[[float], None],
) -> dict[str, np.ndarray]:
    """Trains a head on a bank's draws; returns the course of the training.

    "optimal", "success", "contacts", "length", "route" (episodes,);  "entropy", "value_loss" (updates,)
    """
    episodes, updates = [], []
    for start in range(0, config.episodes, config.batch):
        n = min(config.batch, config.episodes - start)
        entry, slab = (rng.integers(0, many, n) for many in training.contents.shape[:2])
        wire = training.wires(channel, entry, slab)
        with torch.no_grad():
            policy, value = head.outlook(wire)
            route = torch.from_numpy(drawn(policy.probs.numpy(), rng))
        played = _played(training, entry, slab, route.numpy())
        returns = torch.from_numpy(played.pop("returns")).float()
        batch = ppo.Batch(wire, route, policy.log_prob(route), returns - value, returns)
        statistics = ppo.update(head, optimiser, batch, config.ppo, config.minibatch, rng)
        episodes.append(played | {"route": route.numpy().astype(np.int8)})
        updates.append((policy.entropy().mean().item(), statistics.value_loss))
        report((start + n) / config.episodes)
    names = zip(("entropy", "value_loss"), zip(*updates, strict=True), strict=True)
    return {name: np.concatenate([e[name] for e in episodes]) for name in episodes[0]} | {
        name: np.array(values, np.float32) for name, values in names
    }


def evaluate(head: RouteHead, held_out: Bank, channel: Channel, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Greedy choices of a frozen head, one episode per sender of the channel, the slab placed at random.

    The held-out draws are taken in turn. Returns "optimal", "success", "contacts", "length", "route", each (episodes,).
    """
    n = channel.senders
    entry, slab = np.arange(n) % len(held_out.contents), rng.integers(0, held_out.contents.shape[1], n)
    route = head.greedy(held_out.wires(channel, entry, slab))
    played = _played(held_out, entry, slab, route)
    played.pop("returns")
    return played | {"route": route}


def drawn(shares: Float[np.ndarray, "b c"], rng: np.random.Generator) -> Int[np.ndarray, " b"]:
    """A route for each row, with the probabilities of its c routes."""
    above = shares[:, :0:-1].cumsum(axis=1)  # (b, c - 1): of the last route, of the last two, ...
    return (rng.random(len(shares))[:, None] < above).sum(axis=1)


def _played(
    bank: Bank,
    entry: Int[np.ndarray, " b"],
    slab: Int[np.ndarray, " b"],
    route: Int[np.ndarray, " b"],
) -> dict[str, np.ndarray]:
    """Outcomes of episodes; optimal when the committed corridor is the slab-free one."""
    at, outcomes = (entry, slab, route), bank.outcomes
    return {
        "optimal": ~bank.blocks[slab, route],
        "success": outcomes.success[at],
        "contacts": outcomes.contacts[at],
        "length": outcomes.length[at],
        "returns": outcomes.returns[at],
    }


def evaluate_head(
    config: EvaluationConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    head: Mapping[str, np.ndarray],
    bank: Mapping[str, np.ndarray],
    encoder: Mapping[str, np.ndarray],
) -> dict:
    """One cell of Table IV: a frozen trained head, choosing greedily, under one wire condition."""
    _, held_out = read_bank(config, bank, encoder)
    rng = Stream.CORRUPTION.generator(seed, config.content)  # the wire conditions of a head share their draws
    channel = channel_of(config, config.episodes, held_out.contents.shape[-1], rng)
    return evaluate(read_head(head), held_out, channel, rng)


def read_head(result: Mapping[str, np.ndarray]) -> RouteHead:
    """The trained head in a result of `train_head`."""
    width, routes = result["head.hidden.0.weight"].shape[1], len(result["head.logits.bias"])
    return restored(RouteHead(width, routes), result, "head").requires_grad_(False)
