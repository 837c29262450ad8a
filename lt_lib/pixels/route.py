"""Stage 2: the route head learns from the team's episode return alone (Sections Route head, Rendered pixels).

The head sees the wire and nothing else, the executor cannot see the wire, so the route has one possible source of
information. One draw an episode, credited with the whole return; nobody tells the head whether it matched the slab.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lt_lib import ppo
from lt_lib.comm.channel import CORRUPTIONS, deliver
from lt_lib.comm.messages import CONTENTS, Sender
from lt_lib.comm.route_head import RouteHead
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import Layout, load_layout
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.pixels.episodes import SLABS, Outcomes
from lt_lib.settings.pixels import EvaluationConfig, HeadConfig

CHUNK = 1024  # frames encoded at a time


class Bank(NamedTuple):
    """The wire and the outcome of every draw of the scene: wires (E, slab, W), outcomes (E, slab, route)."""

    wires: Float[Tensor, "e slab w"]
    outcomes: Outcomes

    def take(self, entries: slice) -> "Bank":
        return Bank(self.wires[entries], Outcomes(*(values[entries] for values in self.outcomes)))


def sent_wires(
    layout: Layout,
    encoder: FrozenEncoder,
    content: str,
    spawn: Float[np.ndarray, "e 3"],
    scout: Float[np.ndarray, "e 3"],
) -> Float[Tensor, "e slab w"]:
    """What reaches the navigator at the commit step, under either placement; the scout saw it one step earlier."""
    camera, wires = FastCamera(layout), []
    for slab in range(SLABS):
        slabs = np.full(len(spawn), slab)
        frames = camera.frames(scout, slabs, spawn[:, :2])
        parts = []
        for i in range(0, len(spawn), CHUNK):
            part = slice(i, i + CHUNK)
            still = np.zeros((len(scout[part]), 2))
            sent = CONTENTS[content](Sender(layout, encoder, frames[part], scout[part], still, slabs[part]))
            parts.append(deliver(sent, scout[part, :2], spawn[part, :2], layout.communication_radius))
        wires.append(torch.cat(parts))
    return torch.stack(wires, dim=1)


def read_bank(
    config: HeadConfig | EvaluationConfig, bank: Mapping[str, np.ndarray], encoder: Mapping[str, np.ndarray]
) -> tuple[Bank, Bank]:
    """The bank's training draws and its held-out draws, with the wires of the configured content."""
    layout, frozen = load_layout(config.layout), FrozenEncoder(encoder, config.device)
    wires = sent_wires(layout, frozen, config.content, bank["spawn"], bank["scout"])
    whole = Bank(wires, Outcomes(**{name: bank[name] for name in Outcomes._fields}))
    held_out = int(len(wires) * config.held_out)
    return whole.take(slice(held_out, None)), whole.take(slice(held_out))


def train_head(
    config: HeadConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    bank: Mapping[str, np.ndarray],
    encoder: Mapping[str, np.ndarray],
) -> dict:
    """Trains one head; returns its weights, what became of every training episode, and a greedy evaluation.

    "head.*"           weights
    "optimal", "success", "contacts", "length" (episodes,) of the head's sampled choices, in order
    "entropy" (updates,) nats, "value_loss" (updates,)
    "greedy.*"         the same four over the held-out draws, both placements each, choices greedy
    """
    rng = np.random.default_rng([seed, 3])
    training, held_out = read_bank(config, bank, encoder)
    corrupt = CORRUPTIONS[config.wire]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        head = RouteHead(training.wires.shape[-1])
    optimiser = torch.optim.Adam(head.parameters(), lr=config.lr, eps=1e-5)
    episodes, updates = [], []
    for start in range(0, config.episodes, config.batch):
        n = min(config.batch, config.episodes - start)
        entry, slab = rng.integers(0, len(training.wires), n), rng.integers(0, SLABS, n)
        wire = corrupt(training.wires[entry, slab], rng)
        with torch.no_grad():
            policy = head.policy(wire)
            route = torch.from_numpy((rng.random(n) < policy.probs[:, 1].numpy()).astype(np.int64))
            value = head.value(head.hidden(wire)).squeeze(1)
        played = _played(training.outcomes, entry, slab, route.numpy())
        returns = torch.from_numpy(played.pop("returns")).float()
        batch = ppo.Batch(wire, route, policy.log_prob(route), returns - value, returns)
        statistics = ppo.update(head, optimiser, batch, config.ppo, config.minibatch, rng)
        episodes.append(played)
        updates.append((policy.entropy().mean().item(), statistics.value_loss))
        report((start + n) / config.episodes)
    greedy = evaluate(head, held_out, config.wire, rng)
    names = zip(("entropy", "value_loss"), zip(*updates, strict=True), strict=True)
    return (
        {f"head.{k}": v.numpy() for k, v in head.state_dict().items()}
        | {name: np.concatenate([e[name] for e in episodes]) for name in episodes[0]}
        | {name: np.array(values, np.float32) for name, values in names}
        | {f"greedy.{name}": values for name, values in greedy.items()}
    )


@torch.no_grad()
def evaluate(
    head: RouteHead, held_out: Bank, corruption: str, rng: np.random.Generator, episodes: int | None = None
) -> dict[str, np.ndarray]:
    """Greedy choices of a frozen head under a wire condition; every held-out draw under a placement drawn by chance.

    Returns "optimal", "success", "contacts", "length", "route", each (episodes,).
    """
    n = episodes or len(held_out.wires)
    entry, slab = np.arange(n) % len(held_out.wires), rng.integers(0, SLABS, n)
    wire = CORRUPTIONS[corruption](held_out.wires[entry, slab], rng)
    route = head.policy(wire).logits.argmax(1).numpy()
    played = _played(held_out.outcomes, entry, slab, route)
    played.pop("returns")
    return played | {"route": route}


def _played(
    outcomes: Outcomes,
    entry: Int[np.ndarray, " b"],
    slab: Int[np.ndarray, " b"],
    route: Int[np.ndarray, " b"],
) -> dict[str, np.ndarray]:
    """What became of episodes: optimal when the committed corridor is the slab-free one."""
    at = (entry, slab, route)
    return {
        "optimal": route != slab,
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
    """One cell of Table IV: a frozen trained head under one wire condition, greedily."""
    _, held_out = read_bank(config, bank, encoder)
    return evaluate(read_head(head), held_out, config.wire, np.random.default_rng([seed, 4]), config.episodes)


def read_head(result: Mapping[str, np.ndarray]) -> RouteHead:
    """The trained head in a result of `train_head`."""
    weights = {k.removeprefix("head."): torch.tensor(v) for k, v in result.items() if k.startswith("head.")}
    head = RouteHead(weights["hidden.0.weight"].shape[1])
    head.load_state_dict(weights)
    return head.requires_grad_(False)
