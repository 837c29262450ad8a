"""The loop closed behind a camera: scout and navigator see through the surrogate one, the head knows simulation only.

The executor cannot read the message. Given a draw of the scene, the slab and the commanded route, an episode behind a
camera is therefore the same whoever commanded the route, so each is driven once, and every head is scored on them.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lt_lib.beyond.deciders import learned
from lt_lib.beyond.radio import draw_radio_scenes
from lt_lib.comm.channel import ANCHOR, Channel
from lt_lib.comm.messages import CONTENT
from lt_lib.comm.route_head import RouteHead
from lt_lib.envs.arena import Arena
from lt_lib.envs.camera import FastCamera, colours
from lt_lib.envs.layout import Layout, load_layout
from lt_lib.hardware.eye import SurrogateEye
from lt_lib.perception.appearance import draw_appearances, eight_bits, recoloured
from lt_lib.perception.pictures import PictureEncoder
from lt_lib.pixels.episodes import Draws, draw_scenes, drive
from lt_lib.pixels.executor import FrozenExecutor
from lt_lib.pixels.route import committed_wires
from lt_lib.settings.beyond import DrivingConfig, LoopHeadConfig, SightConfig
from lt_lib.settings.streams import Stream
from lt_lib.store.states import restored, state_of


class SimulatedEye:
    """The fast camera's frames as the RGB pictures that a `PictureEncoder` takes."""

    def __init__(self, layout: Layout):
        self._camera = FastCamera(layout)

    def frames(
        self, eyes: Float[np.ndarray, "b 3"], slabs, others: Float[np.ndarray, "b 2"]
    ) -> UInt8[np.ndarray, "b h w 3"]:
        """Arguments as for `FastCamera.frames`."""
        return colours(self._camera.frames(eyes, slabs, others))


def opened(config: SightConfig, rng: np.random.Generator) -> SimulatedEye | SurrogateEye:
    """The configured eye."""
    layout = load_layout(config.layout)
    if config.eye == "simulated":
        return SimulatedEye(layout)
    return SurrogateEye(layout, config.optics, config.eye, config.dim if config.eye == "dim" else 0.0, rng)


def loop_draws(config: SightConfig) -> Draws:
    """The draws of the scene, the same behind every eye."""
    return draw_scenes(load_layout(config.layout), config.draws, Stream.LOOP.generator(0, "draws"))


def look(config: SightConfig, seed: int, *, report: Callable[[float], None], encoder: Mapping[str, np.ndarray]) -> dict:
    """What scouts send behind one eye while the navigators wait at their spawn.

    "latents"   (draws, slab, 64)
    "pictures"  (slab, 64, 64, 3) of the first draw
    """
    draws, placements = loop_draws(config), len(load_layout(config.layout).placements)
    eye, seen = opened(config, Stream.LOOP.generator(seed, "sight", config.eye)), []
    for i in range(config.draws):
        scout, spawn = (np.tile(poses[i], (placements, 1)) for poses in (draws.scout, draws.spawn))
        seen.append(eye.frames(scout, np.arange(placements), spawn[:, :2]))
        report((i + 1) / config.draws)
    latents = PictureEncoder(encoder, config.device).latents(np.concatenate(seen))
    return {"latents": latents.reshape(config.draws, placements, -1), "pictures": seen[0]}


def drive_behind(
    config: DrivingConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    encoder: Mapping[str, np.ndarray],
    executor: Mapping[str, np.ndarray],
) -> dict:
    """Shard `seed` of the episodes behind one eye: the fields of `Outcomes`, each (draws, slab, route)."""
    layout, device = load_layout(config.layout), config.device
    mine = np.array_split(np.arange(config.driven), config.shards)[seed]
    shape = (len(mine), len(layout.placements), len(layout.routes))
    entry, slab, route = (axis.ravel() for axis in np.indices(shape))
    outcome = drive(
        Arena(layout, min(config.rows, len(entry))),
        opened(config, Stream.LOOP.generator(seed, "driving", config.eye)),
        PictureEncoder(encoder, device),
        FrozenExecutor(executor, device),
        loop_draws(config).of(mine[entry]),
        slab,
        route,
        config.commit_step,
        config.horizon,
        report,
    )
    return outcome.shaped(shape)


def train_loop_heads(
    config: LoopHeadConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    bank: Mapping[str, np.ndarray],
    encoder: Mapping[str, np.ndarray],
) -> dict:
    """Heads of `config.heads` seeds, trained on simulated frames alone, floor and walls recoloured as configured.

    "<head>.*"  weights;  "greedy" (heads, scenes) whether choices are right in held-out scenes of the same looks
    """
    layout, cut = load_layout(config.layout), int(config.scenes * config.held_out)
    rng = Stream.LOOP.generator(seed, "heads", f"{config.colour:g}", f"{config.texture:g}")
    scenes = draw_radio_scenes(bank, config.scenes, cut, rng)
    frames = FastCamera(layout).frames(scenes.draws.scout, scenes.slab, scenes.draws.spawn[:, :2])
    looks = draw_appearances(len(frames), layout.camera.pixels, config.colour, config.texture, rng)
    latents = PictureEncoder(encoder, config.device).latents(eight_bits(recoloured(frames, looks)))
    wires = loop_wires(layout, latents, scenes.draws, config.latency, int(bank["commit_step"]))
    rewards, free = scenes.outcomes.returns, ~layout.blocks[scenes.slab]
    states, greedy = {}, []
    for i in range(config.heads):
        own = Stream.READER.generator(i, "loop", f"{config.colour:g}", f"{config.texture:g}")
        head, _ = learned(config, partial(RouteHead, wires.shape[1], free.shape[1]), wires[cut:], rewards[cut:], own)
        states |= state_of(head, str(i))
        greedy.append(free[np.arange(cut), head.greedy(wires[:cut])])
        report((i + 1) / config.heads)
    return states | {"greedy": np.stack(greedy)}


def loop_wires(
    layout: Layout, latents: Float[np.ndarray, "n 64"], draws: Draws, latency: int, commit_step: int
) -> Float[Tensor, "n w"]:
    """What reaches the navigators at the commit step when scouts send these latents."""
    channel = Channel((len(latents),), CONTENT, layout.communication_radius, latency)
    places = draws.scout[:, :2], draws.spawn[:, :2]
    return committed_wires(channel, commit_step, torch.from_numpy(latents).float(), *places)


def loop_heads(trained: Mapping[str, Any], routes: int) -> list[RouteHead]:
    """The heads in a result of `train_loop_heads`."""
    count = len(trained["greedy"])
    return [restored(RouteHead(ANCHOR + CONTENT, routes), trained, str(i)).requires_grad_(False) for i in range(count)]
