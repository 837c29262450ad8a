"""Episodes of the frozen executor, and the bank of them that all message conditions share.

The executor cannot read the message. How an episode goes, given the draw of the scene, the blocked corridor and the
commanded route, is therefore the same for every content, and is simulated once.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lt_lib.envs.arena import HORIZON, NO_CORRIDOR, Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import Layout, load_layout
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.pixels.executor import ROUTES, FrozenExecutor
from lt_lib.settings.pixels import BankConfig

SLABS = 2
ARRIVAL_REWARD = 1.0
CONTACT_REWARD = -0.01  # a control step in contact with the slab


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


class Draws(NamedTuple):
    """What chance decides about a scene besides the slab: spawn and scout poses, (E, 3) metres, metres, radians."""

    spawn: Float[np.ndarray, "e 3"]
    scout: Float[np.ndarray, "e 3"]


def draw_scenes(layout: Layout, n: int, rng: np.random.Generator) -> Draws:
    return Draws(layout.spawn.sample(n, rng), layout.scout.sample(n, rng))


def drive(
    layout: Layout,
    encoder: FrozenEncoder,
    executor: FrozenExecutor,
    draws: Draws,
    slab,
    route,
    envs: int,
    commit_step: int,
    report: Callable[[float], None] = lambda _: None,
) -> Outcomes:
    """Drives E episodes, `envs` at a time, each from its draw to the goal or the time-out.

    slab, route  (E,) 0 left, 1 right: the blocked corridor and the commanded one
    commit_step  the navigator waits until then, since no message can have told it where to go

    A batch always has `envs` rows, so that an episode's arithmetic does not depend on what runs beside it.
    """
    total = len(slab)
    arena, camera = Arena(layout, envs), FastCamera(layout)
    episode = np.arange(envs) % total  # which episode a row plays; rows to spare replay one and are not recorded
    following, finished = min(envs, total), 0
    live, age = np.arange(envs) < total, np.zeros(envs, np.int64)
    outcome = Outcomes(
        np.zeros(total, bool),
        np.zeros(total, np.int64),
        np.zeros(total, np.int64),
        np.full(total, NO_CORRIDOR),
    )
    arena.reset(np.ones(envs, bool), draws.spawn[episode], slab[episode], draws.scout[episode])
    while finished < total:
        latent = encoder.latent(camera.frames(arena.pose, arena.slab, arena.scout[:, :2]))
        action = executor.mean_action(latent, route[episode])
        arena.step(np.where(age[:, None] < commit_step, 0.0, action), live)
        age += 1
        _record(outcome, episode[live], arena, live)
        ended = live & (arena.reached | (age >= HORIZON))
        if ended.any():
            outcome.success[episode[ended]], outcome.length[episode[ended]] = arena.reached[ended], age[ended]
            finished += ended.sum()
            rows = np.flatnonzero(ended)[: total - following]
            live[ended] = False
            live[rows] = True
            episode[rows] = following + np.arange(len(rows))
            following, age[rows] = following + len(rows), 0
            arena.reset(ended & live, draws.spawn[episode], slab[episode], draws.scout[episode])
            report(finished / total)
    return outcome


def _record(outcome: Outcomes, episode, arena: Arena, live):
    outcome.contacts[episode] += arena.contact[live]
    first = outcome.entered[episode] == NO_CORRIDOR
    outcome.entered[episode[first]] = arena.corridor[live][first]


def roll_bank(
    config: BankConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    encoder: Mapping[str, np.ndarray],
    executor: Mapping[str, np.ndarray],
) -> dict:
    """Every outcome of `entries` draws of the scene: arrays (entries, slab, route), and the draws (entries, 3)."""
    layout, device = load_layout(config.layout), config.device
    draws = draw_scenes(layout, config.entries, np.random.default_rng([seed, 2]))
    shape = (config.entries, SLABS, ROUTES)
    entry, slab, route = (axis.ravel() for axis in np.indices(shape))
    outcome = drive(
        layout,
        FrozenEncoder(encoder, device, config.precision),
        FrozenExecutor(executor, device),
        Draws(draws.spawn[entry], draws.scout[entry]),
        slab,
        route,
        config.envs,
        config.commit_step,
        report,
    )
    return draws._asdict() | {name: values.reshape(shape) for name, values in outcome._asdict().items()}
