"""The navigator without a route: velocities end to end, from its own view and the wire (Section From Grid Actions).

The gridworld's protocol, carried over directly: one Gaussian policy over body-frame velocities, trained by PPO from
the team's reward, with nothing between the message and the velocity command. The critic alone sees where the slab is.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from lt_lib import ppo
from lt_lib.comm.channel import ANCHOR, Channel
from lt_lib.comm.messages import CONTENT, CONTENTS, Sender
from lt_lib.envs.arena import Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.geodesic import RouteDistance
from lt_lib.envs.layout import NO_CORRIDOR, SIDES, Layout, load_layout
from lt_lib.perception.encoder import ACTION, LATENT, FrozenEncoder
from lt_lib.perception.frames import free_poses
from lt_lib.settings.streams import Stream
from lt_lib.settings.velocity import Boost, NavigatorConfig
from lt_lib.store.states import after, restored, state_of
from lt_lib.velocity.noise import Ar1

WIRE = ANCHOR + CONTENT
LATERAL = 1  # the action's axis across the robot
READ = 32  # floats that the receiver makes of a message
ARRIVED = 5.0  # reward of the goal
TIME_LIMIT = 300  # control steps of a training episode; a time-out is bootstrapped, not punished


class Navigator(nn.Module):
    """Gaussian policy and central value; an observation is latent 64, wire 66, lateral noise's boost 1, slab 2.

    With one sender, masked attention is its value projection, which starts at zero: every condition starts as the
    navigator without a message.
    """

    def __init__(self):
        super().__init__()
        self.message = nn.Linear(WIRE, READ)
        nn.init.zeros_(self.message.weight)
        nn.init.zeros_(self.message.bias)
        self.velocity = ppo.mlp(LATENT + READ, ACTION, 0.01)
        self.critic = ppo.mlp(LATENT + WIRE + len(SIDES), 1, 1.0)
        self.log_std = nn.Parameter(torch.full((ACTION,), -0.5))

    def mean(self, latent: Float[Tensor, "b 64"], wire: Float[Tensor, "b 66"]) -> Float[Tensor, "b 3"]:
        return self.velocity(torch.cat([latent, self.message(wire)], dim=1))

    def policy(self, observations: Float[Tensor, "b d"]) -> torch.distributions.Normal:
        latent, wire, boost, _ = observations.split([LATENT, WIRE, 1, len(SIDES)], dim=1)
        axes = F.one_hot(torch.tensor(LATERAL), ACTION)
        return torch.distributions.Normal(self.mean(latent, wire), self.log_std.exp() * (1 + axes * (boost - 1)))

    def value(self, observations: Float[Tensor, "b d"]) -> Float[Tensor, " b"]:
        latent, wire, _, slab = observations.split([LATENT, WIRE, 1, len(SIDES)], dim=1)
        return self.critic(torch.cat([latent, wire, slab], dim=1)).squeeze(1)

    def evaluate(self, observations: Float[Tensor, "b d"], actions: Float[Tensor, "b 3"]):
        policy = self.policy(observations)
        return policy.log_prob(actions).sum(1), policy.entropy().sum(1), self.value(observations)


def read_navigator(result: Mapping[str, np.ndarray]) -> Navigator:
    """The navigator in a result of `train_navigator`."""
    return restored(Navigator(), result, "navigator")


class Scouts:
    """Stationary scouts: each repeats, at every step, what it makes of its frame of the episode's start."""

    def __init__(self, layout: Layout, encoder: FrozenEncoder, content: str, n: int, latency: int):
        self._layout, self._encoder, self._write = layout, encoder, CONTENTS[content]
        self._camera, self._held = FastCamera(layout), torch.zeros(n, CONTENT)
        self._channel = Channel((n,), CONTENT, layout.communication_radius, latency)

    def look(self, which: Bool[np.ndarray, " n"], arena: Arena, slab: Int[np.ndarray, " n"]):
        """New contents for the episodes of `which`; `slab` is what the oracle says of each."""
        scout = arena.scout[which]
        frames = self._camera.frames(scout, arena.slab[which], arena.pose[which, :2])
        sent = Sender(self._layout, self._encoder, frames, scout, np.zeros((len(scout), 2)), slab[which])
        self._held[torch.from_numpy(which)] = self._write(sent)

    def wires(
        self, arena: Arena, age: Int[np.ndarray, " b"], rows: Int[np.ndarray, " b"] | None = None
    ) -> Float[Tensor, "b 66"]:
        """Has scouts send, and returns what reaches their navigators; to be called at every step of an episode.

        rows  those that send, all by default
        """
        rows = np.arange(len(self._held)) if rows is None else rows
        self._channel.send(age, self._held[rows], arena.scout[rows, :2], rows)
        return self._channel.receive(age, arena.pose[rows, :2], rows)


class Step(NamedTuple):
    """What a control step led to; `following` is the observation before any reset."""

    rewards: Float[np.ndarray, " n"]
    terminated: Bool[np.ndarray, " n"]
    ended: Bool[np.ndarray, " n"]
    following: Float[Tensor, "n d"]


class Errand:
    """The team's task, many episodes side by side, restarted as they end: reach the goal, keep off the slab.

    `finished` collects (slab, first corridor entered, arrived) of every episode that started at the spawn.
    """

    def __init__(self, config: NavigatorConfig, encoder: FrozenEncoder, rng: np.random.Generator):
        n, layout = config.envs, load_layout(config.layout)
        self._config, self._layout, self._encoder, self._rng = config, layout, encoder, rng
        self._arena, self._camera, self._distance = Arena(layout, n), FastCamera(layout), RouteDistance(layout)
        self._scouts = Scouts(layout, encoder, config.content, n, config.latency)
        self.age, self._first = np.zeros(n, np.int64), np.full(n, NO_CORRIDOR)
        self._from_spawn = np.zeros(n, bool)
        self.finished: list[np.ndarray] = []
        self._restart(np.ones(n, bool))

    def observe(self, boost: float, rows: Int[np.ndarray, " b"] | None = None) -> Float[Tensor, "b d"]:
        """The observations of some rows, all by default."""
        arena, rows = self._arena, np.arange(len(self.age)) if rows is None else rows
        frames = self._camera.frames(arena.pose[rows], arena.slab[rows], arena.scout[rows, :2])
        latent = self._encoder.latent(frames).cpu()
        slab = F.one_hot(torch.from_numpy(arena.slab[rows]), len(SIDES)).float()
        inside = torch.from_numpy(self.age[rows] < self._config.boost.window)[:, None]
        wires = self._scouts.wires(arena, self.age[rows], rows)
        return torch.cat([latent, wires, 1 + (boost - 1) * inside, slab], dim=1)

    def step(self, action: Float[np.ndarray, "n 3"], boost: float) -> Step:
        before = self._potential()
        self._arena.step(action)
        self.age += 1
        arrived, touched, corridor = self._arena.reached, self._arena.contact, self._arena.corridor
        self._first = np.where(self._first == NO_CORRIDOR, corridor, self._first)
        config = self._config
        rewards = self._potential() - before + ARRIVED * arrived - config.hazard * touched - config.step_cost
        terminated = arrived | (touched & config.slab_ends)
        ended = terminated | (self.age >= TIME_LIMIT)
        following = self.observe(boost)
        told = ended & self._from_spawn
        self.finished.append(np.column_stack([self._arena.slab, self._first, arrived])[told])
        if ended.any():
            self._restart(ended)
        return Step(rewards, terminated, ended, following)

    def _potential(self) -> Float[np.ndarray, " n"]:
        """Minus the walking distance to the goal through whichever corridor is nearer, blocked or not, metres."""
        place = self._arena.pose[:, :2]
        return -np.minimum(*(self._distance(place, np.full(len(place), side)) for side in range(len(SIDES))))

    def _restart(self, which: Bool[np.ndarray, " n"]):
        """New episodes: some from the spawn, the others from where the curriculum says, looking ahead."""
        n, rng, layout, config = len(which), self._rng, self._layout, self._config
        slab = rng.integers(0, 2, n) if config.blocked == "random" else np.full(n, SIDES.index(config.blocked))
        scout = layout.scout.sample(n, rng)
        elsewhere = free_poses(layout, slab, rng, apart_from=scout)
        elsewhere[:, 2] /= 2  # within +- 90 degrees of ahead
        allowed = elsewhere[:, 0] > layout.barrier[0] if config.starts == "beyond" else np.ones(n, bool)
        spawn = (rng.random(n) < config.spawn_share) | ~allowed
        self._arena.reset(which, np.where(spawn[:, None], layout.spawn.sample(n, rng), elsewhere), slab, scout)
        self._from_spawn = np.where(which, spawn, self._from_spawn)
        self._first[which], self.age[which] = NO_CORRIDOR, 0
        self._scouts.look(which, self._arena, self._arena.slab)


def train_navigator(
    config: NavigatorConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    encoder: Mapping[str, np.ndarray],
    start: Mapping[str, np.ndarray] | None = None,
) -> dict:
    """Trains one navigator, from scratch or from where an earlier one (`start`) stood.

    "navigator.*"      weights; "<look>.navigator.*" those after each of `config.looks`
    "episodes" (E, 4)  every training episode from the spawn, in order: update, slab, first corridor (-1 none), arrived
    "sigma" (U, 3)     the policy's own standard deviations after every update
    "boost" (U,)       factor on the lateral one in the window
    """
    rng = Stream.NAVIGATOR.generator(seed, *config.condition)
    navigator = ppo.built(lambda: read_navigator(start) if start else Navigator(), rng)
    errand = Errand(config, FrozenEncoder(encoder, config.device, config.precision), rng)
    chains = Ar1(np.full(config.envs, config.boost.tau), rng)
    optimiser = torch.optim.Adam(navigator.parameters(), lr=config.lr, eps=1e-5, fused=True)
    updates = max(1, config.steps // (config.rollout * config.envs))
    episodes, sigmas, boosts, kept = [], [], [], {}
    for i in range(updates):
        boost = annealed(config.boost, i + 1)
        batch = _collect(errand, navigator, chains, config, boost, rng)
        ppo.update(navigator, optimiser, batch, config.ppo, config.minibatch, rng)
        ended = np.concatenate(errand.finished)
        episodes.append(np.column_stack([np.full(len(ended), i), ended]))
        errand.finished.clear()
        sigmas.append(navigator.log_std.detach().exp().numpy().copy())
        boosts.append(boost)
        taken = (i + 1) * config.rollout * config.envs  # control steps
        if taken in config.looks:
            kept |= state_of(navigator, f"{taken}.navigator")
        report((i + 1) / updates)
    return (
        state_of(navigator, "navigator")
        | kept
        | {
            "episodes": np.concatenate(episodes).astype(np.int64),
            "sigma": np.array(sigmas),
            "boost": np.array(boosts),
        }
    )


def stopped(trained: Mapping[str, np.ndarray], look: int, updates: int) -> dict[str, np.ndarray]:
    """A training as it would have been, had it ended at one of its looks (control steps), after so many updates."""
    course = {name: trained[name][:updates] for name in ("sigma", "boost")}
    return after(trained, look) | course | {"episodes": trained["episodes"][trained["episodes"][:, 0] < updates]}


def annealed(boost: Boost, iteration: int) -> float:
    """The factor on the lateral noise in the window: linear from `first` to `last` at iteration `at`, then on to 1."""
    return max(1.0, boost.first + (boost.last - boost.first) * iteration / boost.at)


def _collect(
    errand: Errand,
    navigator: Navigator,
    chains: Ar1,
    config: NavigatorConfig,
    boost: float,
    rng: np.random.Generator,
) -> ppo.Batch:
    """One batch of `rollout` steps in every environment, with advantages."""
    steps = []
    observation = errand.observe(boost)
    for _ in range(config.rollout):
        noise, correlated = rng.standard_normal((config.envs, ACTION)), chains.step(errand.age == 0)
        if boost > 1:  # without a boost the exploration is the policy's own, iid
            noise[:, LATERAL] = np.where(errand.age < config.boost.window, correlated, noise[:, LATERAL])
        with torch.no_grad():
            policy = navigator.policy(observation)
            action = policy.mean + policy.stddev * torch.from_numpy(noise).float()
            log_prob, value = policy.log_prob(action).sum(1), navigator.value(observation)
            step = errand.step(action.numpy(), boost)
            following = navigator.value(step.following)
        flags = (torch.from_numpy(a) for a in (step.rewards.astype(np.float32), step.terminated, step.ended))
        steps.append(ppo.Step(observation, action, log_prob, value, following, *flags))
        observation = step.following
        if step.ended.any():
            restarted = np.flatnonzero(step.ended)
            observation = observation.index_copy(0, torch.from_numpy(restarted), errand.observe(boost, restarted))
    return ppo.batch_of(steps, config.ppo)
