"""A head that reads a stream of messages from scouts that drive: cross-attention over whatever has arrived.

The navigator waits at its spawn until the commit step. Every message travels through the channel: it arrives one step
later, with the sender's place at sending relative to the navigator's. The receiver is the paper's (Section Receiver).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from lt_lib.beyond.deciders import learned
from lt_lib.beyond.motion import errands, patrols
from lt_lib.beyond.senders import frozen
from lt_lib.comm.channel import ANCHOR, WIRES, Channel
from lt_lib.comm.messages import CONTENT, CONTENTS, Sender
from lt_lib.comm.receiver import Receiver
from lt_lib.comm.route_head import Chooser, RouteHead
from lt_lib.envs.arena import CONTROL_HZ
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import SIDES, Layout, load_layout
from lt_lib.envs.materials import HAZARD
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.pixels.protocol import SEED, PixelProtocol
from lt_lib.settings.beyond import MovingConfig, MovingSizes
from lt_lib.settings.profiles import validated
from lt_lib.settings.streams import Stream
from lt_lib.store.run import Result, Run
from lt_lib.store.states import only

EGO, POOLED = 2, 64  # floats: the navigator's own place, and the pooled messages
WIRE = ANCHOR + 2 * CONTENT  # the widest content is two side by side


class Drives(NamedTuple):
    """N episodes: the slab's corridor, the navigator's place, and each scout's poses."""

    slab: Int[np.ndarray, " n"]
    navigator: Float[np.ndarray, "n 2"]
    poses: Float[np.ndarray, "n s t 3"]


class StreamHead(Chooser):
    """The paper's receiver over a set of messages, and the route head on what it pools.

    Observations are flat: the navigator's place, n wires of some width, and whether each has arrived; see `observed`.
    """

    def __init__(self, messages: int, wire: int = WIRE, routes: int = 2):
        super().__init__()
        self._shape = messages, wire
        self.embed = nn.Sequential(nn.Linear(EGO, POOLED), nn.Tanh())
        self.receiver, self.head = Receiver(POOLED, wire, POOLED), RouteHead(EGO + POOLED, routes)

    def outlook(self, observations: Float[Tensor, "b d"]):
        """The head's policy and value on the pooled messages."""
        place, wires, present = self._parts(observations)
        pooled = self.receiver(self.embed(place), wires, present)
        return self.head.outlook(torch.cat([place, pooled], dim=1))

    def attention(self, observations: Float[Tensor, "b d"]) -> Float[Tensor, "b n"]:
        """The weight of each message in what is pooled."""
        place, wires, present = self._parts(observations)
        return self.receiver.attention(self.embed(place), wires, present)

    def _parts(self, observations: Float[Tensor, "b d"]):
        messages, wire = self._shape
        place, wires, present = observations.split([EGO, messages * wire, messages], dim=1)
        return place, wires.unflatten(1, self._shape), present > 0


def observed(
    layout: Layout, navigator: Float[np.ndarray, "b 2"], wires: Float[Tensor, "b n w"], present: Bool[Tensor, "b n"]
) -> Float[Tensor, "b d"]:
    """What a `StreamHead` observes: the navigator's place in communication radii, and the messages."""
    place = torch.from_numpy(navigator / layout.communication_radius).float()
    return torch.cat([place, wires.flatten(1), present.float()], dim=1)


def draw_drives(layout: Layout, config: MovingConfig, rng: np.random.Generator) -> Drives:
    """Episodes in which the first scout runs an errand with the configured probability, and all others patrol."""
    n, steps = config.scenes, config.commit_step + 1
    slab, errand = rng.integers(0, len(SIDES), n), rng.random(n) < config.errands
    scouts = [patrols(layout, n, steps, config.watching, rng) for _ in range(config.scouts)]
    telling = errands(layout, 1 - slab, steps, rng)
    scouts[0] = np.where(errand[:, None, None], telling, scouts[0])
    return Drives(slab, layout.spawn.sample(n, rng)[:, :2], np.stack(scouts, axis=1))


def stream(
    layout: Layout, encoder: FrozenEncoder, config: MovingConfig, drives: Drives, rng: np.random.Generator
) -> tuple[Float[Tensor, "n d"], Float[np.ndarray, " n"]]:
    """What a `StreamHead` observes at the commit step, and the share of messages whose sender saw the slab."""
    (n, scouts, steps, _), camera = drives.poses.shape, FastCamera(layout)
    channel = Channel((n, scouts), 2 * CONTENT, layout.communication_radius, config.latency, _corrupted(config, rng))
    arrived, present, seeing = [], [], []
    for step in range(steps):
        if step % config.every == 0:
            pose = drives.poses[:, :, step].reshape(-1, 3)
            frames = camera.frames(pose, np.repeat(drives.slab, scouts), np.repeat(drives.navigator, scouts, axis=0))
            sent = _content(layout, encoder, config.content, frames, drives, step)
            channel.send(step, sent.unflatten(0, (n, scouts)), drives.poses[:, :, step, :2])
            seeing.append(HAZARD[frames].any((1, 2)).reshape(n, scouts))
        wires = channel.receive(step, drives.navigator)  # (n, scouts, w)
        if step >= config.latency and (step - config.latency) % config.every == 0:
            arrived.append(wires)
            present.append((wires != 0).any(dim=2))
    wires, there = torch.cat(arrived, dim=1), torch.cat(present, dim=1)
    return observed(layout, drives.navigator, wires, there), np.stack(seeing, axis=2).mean((1, 2))


def train_moving(
    config: MovingConfig, seed: int, *, report: Callable[[float], None], encoder: Mapping[str, np.ndarray]
) -> dict:
    """Heads of `config.heads` seeds that read one content from scouts that drive.

    "greedy"  (heads, scenes) whether the likelier route is the free one, in held-out episodes
    "seeing"  (scenes,) share of the messages whose sender saw the slab
    """
    layout = load_layout(config.layout)
    case = [str(getattr(config, name)) for name in ("errands", "watching", "scouts", "commit_step")]
    rng = Stream.LADDER.generator(seed, "moving", *case)  # contents share their episodes
    drives = draw_drives(layout, config, rng)
    observed, seeing = stream(layout, FrozenEncoder(encoder, config.device), config, drives, rng)
    rewards, cut = np.eye(len(SIDES))[1 - drives.slab], int(config.scenes * config.held_out)
    messages = (observed.shape[1] - EGO) // (WIRE + 1)
    greedy = []
    for head in range(config.heads):
        own = Stream.READER.generator(head, "moving", config.content, config.wire, *case)
        network, _ = learned(config, lambda: StreamHead(messages), observed[cut:], rewards[cut:], own)
        greedy.append(network.greedy(observed[:cut]) != drives.slab[:cut])
        report((head + 1) / config.heads)
    return {"greedy": np.stack(greedy), "seeing": seeing[:cut]}


def _content(
    layout: Layout, encoder: FrozenEncoder, content: str, frames, drives: Drives, step: int
) -> Float[Tensor, "m c"]:
    """What every scout says at a step, padded to the widest content."""
    now, before = drives.poses[:, :, step].reshape(-1, 3), drives.poses[:, :, max(step - 1, 0)].reshape(-1, 3)
    velocity = (now - before)[:, :2] * CONTROL_HZ
    sender = Sender(layout, encoder, frames, now, velocity, np.repeat(drives.slab, drives.poses.shape[1]))
    parts = [CONTENTS[name](sender) for name in content.split(" and ")]
    said = torch.cat(parts, dim=1)
    return nn.functional.pad(said, (0, 2 * CONTENT - said.shape[1]))


def _corrupted(config: MovingConfig, rng: np.random.Generator) -> Callable[[Tensor], Tensor]:
    return lambda wire: WIRES[config.wire](wire, rng)


@dataclass(frozen=True)
class MovingProtocol:
    """Heads behind the paper's frozen encoder, one case after another."""

    sizes: MovingSizes
    pixels: PixelProtocol

    @classmethod
    def of(cls, moving: Mapping[str, Any], pixels: PixelProtocol) -> "MovingProtocol":
        """From a notebook's parameter. Raises UserError for an unusable one."""
        return cls(validated(MovingSizes, "moving", dict(moving)), pixels)

    def read(self, cases: Mapping[Any, Mapping[str, Any]], what: str) -> dict[Any, Result]:
        """What heads make of each case, by the name of the case; a case changes settings of `MovingConfig`."""
        encoder = self.pixels.encoder_weights()
        weights = frozen(encoder) | only(encoder, "P")
        shared = self.sizes.model_dump() | {
            "layout": self.pixels.layout,
            "device": self.pixels.sizes.encoder.device,
            "latency": self.pixels.sizes.latency,
        }
        runs = [
            Run(train_moving, MovingConfig(**shared | dict(case)), SEED, {"encoder": weights})
            for case in cases.values()
        ]
        return dict(zip(cases, self.pixels.store.fetch(runs, what), strict=True))
