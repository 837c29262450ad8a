"""Exploration coverage: a frozen navigator under imposed lateral noise, without learning (Table II)."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lt_lib.envs.arena import Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import NO_CORRIDOR, SIDES, Layout, load_layout
from lt_lib.perception.encoder import ACTION, FrozenEncoder
from lt_lib.pixels.episodes import draw_scenes
from lt_lib.settings.base import LATENCY
from lt_lib.settings.streams import Stream
from lt_lib.settings.velocity import Boost, Exploration, RolloutConfig
from lt_lib.velocity.navigator import LATERAL, Navigator, Scouts, read_navigator
from lt_lib.velocity.noise import Ar1

APPROACH = 40  # control steps before the mouths, over which the bit's effect on the lateral mean is measured
EVERY = 4  # control steps between the recorded points of a path
# The rows of Table II by claim: lateral sigma in units of full command, correlation time in control steps
TABLE_2: Mapping[str, Exploration] = MappingProxyType(
    {
        "cov.s055_t0": Exploration(sigma=0.55),
        "cov.s055_t30": Exploration(sigma=0.55, tau=30.0),
        "cov.s100_t0": Exploration(sigma=1.0),
        "cov.s100_t30": Exploration(sigma=1.0, tau=30.0),
        "cov.s100_t100": Exploration(sigma=1.0, tau=100.0),
        "cov.s165_t30": Exploration(sigma=1.65, tau=30.0),
        "cov.s165_t100": Exploration(sigma=1.65, tau=100.0),
    }
)
# Section Effect of increased exploration noise: one process, confined to the window of the boost or not
WINDOWED: Mapping[str, Exploration] = MappingProxyType(
    {
        "cov.window_ar": Exploration(sigma=1.65, tau=30.0, window=Boost().window),
        "cov.episode_ar": Exploration(sigma=1.65, tau=30.0),
    }
)
# What the paper says of each row: the coverage that is not reached (below) or exceeded (above), and whether success is
# that of a competent navigator; it prints one half for the window, which is neither
STATED: Mapping[str, tuple[str, float, bool | None]] = MappingProxyType(
    {
        "cov.s055_t0": ("below", 0.05, True),
        "cov.s055_t30": ("below", 0.05, True),
        "cov.s100_t0": ("below", 0.05, True),
        "cov.s100_t30": ("below", 0.1, False),
        "cov.s100_t100": ("below", 0.1, False),
        "cov.s165_t30": ("above", 0.05, False),
        "cov.s165_t100": ("above", 0.05, False),
        "cov.window_ar": ("above", 0.05, None),
        "cov.episode_ar": ("above", 0.05, False),
    }
)


class Episodes(NamedTuple):
    """The outcomes of E episodes."""

    success: Bool[np.ndarray, " e"]  # the goal was reached within the horizon
    length: Int[np.ndarray, " e"]  # control steps
    contacts: Int[np.ndarray, " e"]  # control steps in contact with the slab
    first: Int[np.ndarray, " e"]  # first corridor entered: 0 left, 1 right, -1 none
    entered: Bool[np.ndarray, "e 2"]  # whether the left and the right corridor were ever entered
    shift: Float[np.ndarray, "e 2"]  # |change of the lateral mean| when the bit flips, policy sds: approach, all
    path: Float[np.ndarray, "e t 2"]  # metres, at every fourth control step, NaN after the end


class Imposed(NamedTuple):
    """The exploration of E episodes: lateral AR(1) noise in the first `window` steps, otherwise the policy's own."""

    sigma: Float[np.ndarray, " e"]  # stationary standard deviation, units of full command
    tau: Float[np.ndarray, " e"]  # correlation time, control steps
    window: Int[np.ndarray, " e"]  # control steps
    own: Float[np.ndarray, " e"]  # factor on the policy's own noise; 0 is deterministic

    def take(self, live: Bool[np.ndarray, " e"]) -> "Imposed":
        """The same for the live episodes only."""
        return Imposed(*(values[live] for values in self))


def explore(
    mean: Float[Tensor, "b 3"],
    own_std: Float[Tensor, "3"],
    imposed: Imposed,
    chain: Float[np.ndarray, " b"],
    age: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "b 3"]:
    """Actions before clipping; `chain` is the unit AR(1) noise of this step, `age` the control steps taken so far."""
    noise = rng.standard_normal(mean.shape) * own_std.numpy() * imposed.own[:, None]  # (b, 3)
    noise[:, LATERAL] = np.where(age < imposed.window, imposed.sigma * chain, noise[:, LATERAL])
    return mean.numpy() + noise


@torch.inference_mode()
def play(
    layout: Layout,
    encoder: FrozenEncoder,
    navigator: Navigator,
    content: str,
    slab: Int[np.ndarray, " e"],
    told: Int[np.ndarray, " e"],
    imposed: Imposed,
    horizon: int,
    rng: np.random.Generator,
    latency: int = LATENCY,
    report: Callable[[float], None] = lambda _: None,
) -> Episodes:
    """Plays E episodes side by side, each from its own draw of the scene to the goal or the time-out.

    slab     (E,) blocked corridor, 0 left, 1 right
    told     (E,) blocked corridor according to the oracle's message
    horizon  time-out in control steps
    report   is called with the share done
    """
    n = len(slab)
    arena, camera = Arena(layout, n), FastCamera(layout)
    scouts, liars = (Scouts(layout, encoder, content, n, latency) for _ in range(2))
    draws, chains = draw_scenes(layout, n, rng), Ar1(imposed.tau, rng)
    arena.reset(np.ones(n, bool), draws.spawn, slab, draws.scout)
    scouts.look(np.ones(n, bool), arena, told)
    liars.look(np.ones(n, bool), arena, 1 - told)
    live, done = np.ones(n, bool), _blank(n, horizon)
    std = navigator.log_std.exp()
    for age in range(horizon):
        ages = np.full(n, age)
        latent = encoder.latent(camera.frames(arena.pose[live], slab[live], arena.scout[live, :2])).cpu()  # (b, 64)
        mean = navigator.mean(latent, scouts.wires(arena, ages)[live])  # (b, 3)
        other = navigator.mean(latent, liars.wires(arena, ages)[live])
        shift = ((other - mean)[:, LATERAL].abs() / std[LATERAL]).numpy()  # (b,)
        done.shift[live] += np.column_stack([shift * (age < APPROACH), shift])
        chain = chains.step(ages == 0)[live]
        action = np.zeros((n, ACTION))
        action[live] = explore(mean, std, imposed.take(live), chain, age, rng)
        if age % EVERY == 0:
            done.path[live, age // EVERY] = arena.pose[live, :2]
        arena.step(action, live)
        live = _record(done, arena, live, age + 1)
        report((age + 1) / horizon)
        if not live.any():
            break
    done.shift[:] /= np.column_stack([np.minimum(done.length, APPROACH), done.length])
    return done


def _blank(n: int, horizon: int) -> Episodes:
    return Episodes(
        np.zeros(n, bool),
        np.full(n, horizon),
        np.zeros(n, np.int64),
        np.full(n, NO_CORRIDOR),
        np.zeros((n, len(SIDES)), bool),
        np.zeros((n, 2)),
        np.full((n, -(-horizon // EVERY), 2), np.nan, np.float32),
    )


def _record(done: Episodes, arena: Arena, live: Bool[np.ndarray, " e"], age: int) -> Bool[np.ndarray, " e"]:
    """Records the outcome of the latest step in `done`; returns which episodes are still live."""
    done.contacts[live] += arena.contact[live]
    for side in range(len(SIDES)):
        done.entered[:, side] |= live & (arena.corridor == side)
    fresh = live & (done.first == NO_CORRIDOR)
    done.first[fresh] = arena.corridor[fresh]
    arrived = live & arena.reached
    done.success[arrived], done.length[arrived] = True, age
    return live & ~arrived


def started(layout: Layout, start: str) -> Layout:
    """The layout with its spawn moved in front of the 'left' or 'right' corridor's mouth; unchanged for 'spawn'."""
    if start == "spawn":
        return layout
    place = layout.choice_points[SIDES.index(start)].model_dump()
    return layout.model_copy(update={"spawn": layout.spawn.model_copy(update=place)})


def roll_navigator(
    config: RolloutConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    encoder: Mapping[str, np.ndarray],
    navigator: Mapping[str, np.ndarray],
) -> dict:
    """Plays a frozen navigator under each row of the settings.

    Returns the arrays of `Episodes`, each (rows, episodes, ...), and "slab" (rows, episodes), the blocked corridor
    (0 left, 1 right). "path" has only the first `config.paths` episodes of each row.
    """
    rng = Stream.ROLLOUT.generator(seed, config.content, config.start, *map(str, config.rows))
    shape = (len(config.rows), config.episodes)
    fixed = None if config.blocked == "random" else SIDES.index(config.blocked)
    slab = rng.integers(0, len(SIDES), shape) if fixed is None else np.full(shape, fixed)
    imposed = Imposed(
        *(np.repeat([getattr(row, name) for row in config.rows], config.episodes) for name in Imposed._fields)
    )
    device = config.device
    done = play(
        started(load_layout(config.layout), config.start),
        FrozenEncoder(encoder, device, config.precision),
        read_navigator(navigator),
        config.content,
        slab.ravel(),
        slab.ravel() if config.truthful else 1 - slab.ravel(),
        imposed,
        config.horizon,
        rng,
        config.latency,
        report,
    )
    shaped = {name: values.reshape(*shape, *values.shape[1:]) for name, values in done._asdict().items()}
    return shaped | {"slab": slab, "path": shaped["path"][:, : config.paths]}
