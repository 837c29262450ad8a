"""Episodes of the frozen executor, and the bank of them that all message conditions share.

The executor cannot read the message. Given the draw of the scene, the blocked corridor and the commanded route, an
episode is therefore the same for every content, and is simulated once.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lt_lib.envs.arena import HORIZON, Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import NO_CORRIDOR, Layout, load_layout
from lt_lib.perception.encoder import Frozen, FrozenEncoder
from lt_lib.pixels.executor import FrozenExecutor
from lt_lib.settings.pixels import BankConfig
from lt_lib.settings.streams import Stream

ARRIVAL_REWARD = 1.0
CONTACT_REWARD = -0.01  # per control step in contact with the slab


class Outcomes(NamedTuple):
    """How episodes ended."""

    success: Bool[np.ndarray, "*e"]  # the goal was reached within the horizon
    length: Int[np.ndarray, "*e"]  # control steps
    contacts: Int[np.ndarray, "*e"]  # control steps in contact with the slab
    entered: Int[np.ndarray, "*e"]  # the first corridor entered: 0 left, 1 right, -1 none

    @property
    def returns(self) -> Float[np.ndarray, "*e"]:
        """The team's undiscounted return: arrivals rewarded, slab contacts penalised, nothing else."""
        return ARRIVAL_REWARD * self.success + CONTACT_REWARD * self.contacts

    def shaped(self, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
        """By name, as arrays of another shape."""
        return {name: values.reshape(shape) for name, values in self._asdict().items()}


class Draws(NamedTuple):
    """The random part of a scene besides the slab: spawn and scout poses, (E, 3) metres, metres, radians."""

    spawn: Float[np.ndarray, "e 3"]
    scout: Float[np.ndarray, "e 3"]

    def of(self, entry: Int[np.ndarray, " b"]) -> "Draws":
        """Some of the draws, in any order and number."""
        return Draws(self.spawn[entry], self.scout[entry])


def draw_scenes(layout: Layout, n: int, rng: np.random.Generator) -> Draws:
    return Draws(layout.spawn.sample(n, rng), layout.scout.sample(n, rng))


def drive(
    arena: Arena,
    camera: Any,
    encoder: Frozen,
    executor: FrozenExecutor,
    draws: Draws,
    slab,
    route,
    commit_step: int,
    horizon: int,
    report: Callable[[float], None] = lambda _: None,
) -> Outcomes:
    """Drives E episodes, as many at a time as the arena has scenes, each from its draw to the goal or the time-out.

    camera       has the call of `FastCamera.frames`; the encoder takes what it returns
    slab, route  (E,) the placement of the slabs and the commanded corridor; with two of them, 0 left, 1 right
    commit_step  the navigator waits until this step, since no message can have told it where to go
    horizon      control steps until the time-out

    A batch always has as many rows, so that an episode's arithmetic does not depend on what runs beside it.
    """
    seats, outcome = Seats(arena.n, len(slab)), none_yet(len(slab))
    episode = seats.episode  # spare rows replay an episode and are not recorded
    arena.reset(np.ones(arena.n, bool), draws.spawn[episode], slab[episode], draws.scout[episode])
    while seats.live.any():
        latent = encoder.latent(camera.frames(arena.pose, arena.slab, arena.scout[:, :2]))
        action = executor.mean_action(latent, route[seats.episode])
        arena.step(np.where(seats.age[:, None] < commit_step, 0.0, action), seats.live)
        seats.age += 1
        record(outcome, arena, seats)
        ended = seats.live & (arena.reached | (seats.age >= horizon))
        if ended.any():
            fresh, episode = seats.pass_on(ended), seats.episode
            arena.reset(fresh, draws.spawn[episode], slab[episode], draws.scout[episode])
            report(seats.finished / len(slab))
    return outcome


class Seats:
    """Which episode each row plays: a row whose episode has ended takes the next waiting one."""

    def __init__(self, rows: int, episodes: int):
        self.episode = np.arange(rows) % episodes
        self.live = np.arange(rows) < episodes
        self.age = np.zeros(rows, np.int64)  # control steps
        self.finished, self._following, self._episodes = 0, min(rows, episodes), episodes

    def pass_on(self, ended: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Gives the next episodes to rows whose own have ended; returns the rows with a new one."""
        self.finished += ended.sum()
        rows = np.flatnonzero(ended)[: self._episodes - self._following]
        self.live[ended] = False
        self.live[rows] = True
        self.episode[rows], self.age[rows] = self._following + np.arange(len(rows)), 0
        self._following += len(rows)
        return ended & self.live


def none_yet(episodes: int) -> Outcomes:
    """Outcomes of episodes in which nothing has happened yet."""
    success, length, contacts = np.zeros(episodes, bool), *np.zeros((2, episodes), np.int64)
    return Outcomes(success, length, contacts, np.full(episodes, NO_CORRIDOR))


def record(outcome: Outcomes, arena: Arena, seats: Seats) -> None:
    """Records the effect of the latest step on the live episodes."""
    episode = seats.episode[seats.live]
    outcome.success[episode] = arena.reached[seats.live]
    outcome.length[episode] = seats.age[seats.live]
    outcome.contacts[episode] += arena.contact[seats.live]
    first = outcome.entered[episode] == NO_CORRIDOR
    outcome.entered[episode[first]] = arena.corridor[seats.live][first]


def held_out_draws(bank: Mapping[str, Any]) -> int:
    """Number of a bank's draws held out for evaluation; they are its first ones."""
    return int(len(bank["spawn"]) * bank["held_out"])


def roll_bank(
    config: BankConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    encoder: Mapping[str, np.ndarray],
    executor: Mapping[str, np.ndarray],
) -> dict:
    """Every outcome of `entries` draws of the scene: arrays (entries, slab, route), and the draws (entries, 3).

    "commit_step" and "held_out" are passed on to whatever trains or evaluates on the bank's scenes.
    """
    layout, device = load_layout(config.layout), config.device
    draws = draw_scenes(layout, config.entries, Stream.BANK.generator(seed))
    shape = (config.entries, len(layout.placements), len(layout.routes))
    entry, slab, route = (axis.ravel() for axis in np.indices(shape))
    outcome = drive(
        Arena(layout, min(config.envs, len(entry))),
        FastCamera(layout),
        FrozenEncoder(encoder, device, config.precision),
        FrozenExecutor(executor, device),
        draws.of(entry),
        slab,
        route,
        config.commit_step,
        HORIZON,
        report,
    )
    return draws._asdict() | outcome.shaped(shape) | {"commit_step": config.commit_step, "held_out": config.held_out}


def obedience(bank: Mapping[str, Any]) -> float:
    """Share of a bank's episodes in which the executor entered the commanded corridor."""
    return float((bank["entered"] == np.arange(bank["entered"].shape[-1])).mean())


def arrival(bank: Mapping[str, Any], blocks: Bool[np.ndarray, "slab route"]) -> float:
    """Share of a bank's episodes on free routes that reached the goal: what a head's reward can be, at best."""
    return float(bank["success"][:, ~blocks].mean())


def slab_reached(bank: Mapping[str, Any], blocks: Bool[np.ndarray, "slab route"]) -> float:
    """Share of a bank's episodes on blocked routes that enter the commanded corridor and touch a slab."""
    reached = (bank["entered"] == np.arange(blocks.shape[1])) & (bank["contacts"] > 0)
    return float(reached[:, blocks].mean())
