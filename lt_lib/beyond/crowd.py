"""Many scouts, of which one sees the slab and one may lie; the paper's cross-attention over all of them.

The informed scout stands at the layout's post, the others anywhere on the map from where they see no slab. A liar sends
what the informed scout sees in another scene, with an anchor that is right: its own place, wherever it stands.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lt_lib.beyond.deciders import learned
from lt_lib.beyond.moving import StreamHead, observed
from lt_lib.comm.channel import ANCHOR, Channel
from lt_lib.comm.messages import CONTENT
from lt_lib.envs.camera import FastCamera, colours
from lt_lib.envs.layout import Layout, load_layout
from lt_lib.envs.occlusion import hazard_pixels
from lt_lib.perception.frames import free_poses
from lt_lib.perception.pictures import PictureEncoder
from lt_lib.settings.beyond import CrowdConfig
from lt_lib.settings.streams import Stream

CEILING_BESIDE = 0.75  # of a reader who cannot tell a liar from the informed scout: both agree in half of the scenes


class Crowd(NamedTuple):
    """n scenes with s scouts each, in random order."""

    slab: Int[np.ndarray, " n"]
    navigator: Float[np.ndarray, "n 2"]
    scouts: Float[np.ndarray, "n s 3"]
    informed: Int[np.ndarray, " n"]  # which scout sees the slab
    liar: Int[np.ndarray, " n"]  # which one would lie, if any did


def draw_crowd(layout: Layout, config: CrowdConfig, rng: np.random.Generator) -> Crowd:
    """Scenes whose informed scout, and its liar, are any of the scouts."""
    n, count = config.scenes, config.scouts
    slab, navigator = rng.integers(0, len(layout.placements), n), layout.spawn.sample(n, rng)
    order = rng.permuted(np.tile(np.arange(count), (n, 1)), axis=1)
    informed, liar = order[:, 0], order[:, min(1, count - 1)]
    scouts = blind_poses(layout, n * count, rng).reshape(n, count, 3)
    if config.liar == "at the post":
        scouts[np.arange(n), liar] = layout.scout.sample(n, rng)
    scouts[np.arange(n), informed] = layout.scout.sample(n, rng)
    return Crowd(slab, navigator[:, :2], scouts, informed, liar)


def blind_poses(layout: Layout, n: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Poses anywhere on the map from where no placement shows a slab."""
    camera, poses, wanted = FastCamera(layout), np.zeros((n, 3)), np.arange(n)
    placements = range(len(layout.placements))
    while len(wanted):
        poses[wanted] = free_poses(layout, rng.integers(0, len(placements), len(wanted)), rng)
        away = np.tile(layout.spawn.array[:2], (len(wanted), 1))
        seen = [hazard_pixels(camera, poses[wanted], np.full(len(wanted), slab), away) for slab in placements]
        wanted = wanted[np.any(seen, axis=0)]
    return poses


def crowd_messages(
    layout: Layout, encoder: PictureEncoder, crowd: Crowd, lying: bool, latency: int, rng: np.random.Generator
) -> Float[Tensor, "n d"]:
    """What a `StreamHead` observes once every scout has sent its latent through the channel.

    lying  whether the liar sends what the informed scout of another scene sees
    """
    n, count, _ = crowd.scouts.shape
    camera = FastCamera(layout)
    slab, others = np.repeat(crowd.slab, count), np.repeat(crowd.navigator, count, axis=0)
    frames = camera.frames(crowd.scouts.reshape(-1, 3), slab, others)
    said = torch.from_numpy(encoder.latents(colours(frames))).reshape(n, count, CONTENT)
    if lying:
        elsewhere = rng.permutation(n)
        said[np.arange(n), crowd.liar] = said[elsewhere, crowd.informed[elsewhere]]
    channel = Channel((n, count), CONTENT, layout.communication_radius, latency)
    channel.send(0, said, crowd.scouts[..., :2])
    wires = channel.receive(latency, crowd.navigator)
    return observed(layout, crowd.navigator, wires, (wires != 0).any(dim=2))


def train_crowd(
    config: CrowdConfig, seed: int, *, report: Callable[[float], None], sender: Mapping[str, np.ndarray]
) -> dict:
    """Heads of `config.heads` seeds that hear a crowd, trained without its liar and with it.

    "<trained>, <tested>"            (heads, scenes) of greedy choices in held-out scenes, both of "honest" and "lying"
    "attention <trained>, <tested>"  (heads, scenes) on the informed scout
    """
    layout, encoder = load_layout(config.layout), PictureEncoder(sender, config.device)
    rng = Stream.CROWD.generator(seed, str(config.scouts), config.liar)
    crowd, cut = draw_crowd(layout, config, rng), int(config.scenes * config.held_out)
    states = ("honest",) if config.liar == "nobody" else ("honest", "lying")
    messages = {
        state: crowd_messages(layout, encoder, crowd, state == "lying", config.latency, rng) for state in states
    }
    free, found = ~layout.blocks[crowd.slab], {}
    make = partial(StreamHead, config.scouts, ANCHOR + CONTENT)
    for trained in states:
        for head in range(config.heads):
            own = Stream.READER.generator(head, "crowd", trained, str(config.scouts), config.liar)
            network, _ = learned(config, make, messages[trained][cut:], free[cut:].astype(float), own)
            for tested in states:
                choice = _choice(network, messages[tested][:cut], free[:cut], crowd.informed[:cut])
                for name, values in zip(
                    (f"{trained}, {tested}", f"attention {trained}, {tested}"), choice, strict=True
                ):
                    found.setdefault(name, []).append(values)
            report((states.index(trained) + (head + 1) / config.heads) / len(states))
    return {name: np.stack(values) for name, values in found.items()}


def _choice(
    network: StreamHead, shown: Float[Tensor, "n d"], free: Bool[np.ndarray, "n routes"], informed
) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Whether greedy choices are right, and the attention on the informed scout."""
    rows = np.arange(len(shown))
    with torch.no_grad():
        weights = network.attention(shown).numpy()
    return free[rows, network.greedy(shown)], weights[rows, informed]
