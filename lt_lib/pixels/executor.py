"""The low-level controller: drives a commanded route from the navigator's own camera (Section Route head).

It sees its latent and the route, never a message. It is pretrained by PPO with route-conditioned potential shaping
and obedience as success, then frozen.
"""

from collections.abc import Callable, Mapping

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from lt_lib import ppo
from lt_lib.envs.arena import Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.geodesic import RouteDistance
from lt_lib.envs.layout import NO_CORRIDOR, Layout, load_layout
from lt_lib.perception.encoder import ACTION, LATENT, FrozenEncoder
from lt_lib.perception.frames import free_poses
from lt_lib.settings.pixels import ExecutorConfig
from lt_lib.settings.streams import Stream
from lt_lib.store.states import state_of

FROM_SPAWN = 0.5  # share of pretraining episodes that start at the spawn
TIME_LIMIT = 300  # control steps of a pretraining episode; a time-out is bootstrapped, not punished
ENTERED, DISOBEYED, ARRIVED, BLOCKED = (
    2.0,
    -5.0,
    5.0,
    5.0,
)  # rewards; BLOCKED: reaching the slab of the commanded corridor


class Executor(nn.Module):
    """Gaussian policy over body-frame velocities, and a value function; 128-128 tanh each."""

    def __init__(self, routes: int = 2):
        super().__init__()
        self.mean, self.critic = ppo.mlp(LATENT + routes, ACTION, 0.01), ppo.mlp(LATENT + routes, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((ACTION,), -0.5))

    def evaluate(self, observations: Float[Tensor, "b d"], actions: Float[Tensor, "b 3"]):
        policy = torch.distributions.Normal(self.mean(observations), self.log_std.exp())
        return policy.log_prob(actions).sum(1), policy.entropy().sum(1), self.critic(observations).squeeze(1)


class FrozenExecutor:
    """The pretrained controller: the policy's mean, no exploration, no gradient."""

    def __init__(self, weights: Mapping[str, np.ndarray], device: str = "cpu"):
        self.routes = weights["mean.0.weight"].shape[1] - LATENT
        self._policy = Executor(self.routes).to(device).requires_grad_(False)
        self._policy.load_state_dict(
            {name: torch.tensor(np.asarray(weights[name])) for name in self._policy.state_dict()}
        )

    @torch.inference_mode()
    def mean_action(self, latent: Float[Tensor, "b 64"], route) -> Float[np.ndarray, "b 3"]:
        """Body-frame velocities before clipping, for a commanded route (B,); of two, 0 is left, 1 right."""
        return self._policy.mean(with_route(latent, route, self.routes)).cpu().numpy()


def with_route(latent: Float[Tensor, "b 64"], route, routes: int) -> Float[Tensor, "b d"]:
    """The executor's observation: its own latent and the one-hot route of so many."""
    one_hot = F.one_hot(torch.as_tensor(route, device=latent.device), routes)
    return torch.cat([latent, one_hot.to(latent.dtype)], dim=1)


class Driving:
    """The executor's pretraining task: many episodes side by side, restarted as they end."""

    def __init__(self, layout: Layout, encoder: FrozenEncoder, n: int, rng: np.random.Generator):
        self._layout, self._encoder, self._rng = layout, encoder, rng
        self._arena, self._camera, self._distance = (
            Arena(layout, n),
            FastCamera(layout),
            RouteDistance(layout),
        )
        self.route, self._entered, self._age = np.zeros(n, np.int64), np.zeros(n, bool), np.zeros(n, np.int64)
        self._restart(np.ones(n, bool))

    def observe(self, rows: Int[np.ndarray, " b"] | None = None) -> Float[Tensor, "b d"]:
        """The observations of some rows, all by default."""
        arena, rows = self._arena, np.arange(len(self.route)) if rows is None else rows
        frames = self._camera.frames(arena.pose[rows], arena.slab[rows], arena.scout[rows, :2])
        return with_route(self._encoder.latent(frames), self.route[rows], len(self._layout.routes))

    def step(self, action):
        """One control step; returns rewards, obedient, terminated, ended and the observation before any reset."""
        before = self._potential()
        self._arena.step(action)
        self._age += 1
        corridor = self._arena.corridor
        inside = corridor == self.route
        wrong = (corridor != NO_CORRIDOR) & ~inside
        arrived = self._arena.reached
        blocked = self._arena.contact & self._layout.blocks[self._arena.slab, self.route]
        terminated = wrong | arrived | blocked
        first = inside & ~self._entered
        self._entered |= inside
        rewards = self._potential() - before  # undiscounted: gamma < 1 would pay for standing far away
        rewards = rewards + ENTERED * first + DISOBEYED * wrong + ARRIVED * arrived + BLOCKED * blocked
        ended = terminated | (self._age >= TIME_LIMIT)
        following = self.observe()
        obedient = arrived | blocked
        if ended.any():
            self._restart(ended)
        return rewards, obedient, terminated, ended, following

    def _potential(self):
        """Minus the walking distance to the goal through the commanded corridor, metres."""
        return -self._distance(self._arena.pose[:, :2], self.route)

    def _restart(self, which):
        """New episodes: half from the spawn, half from anywhere outside the corridor that was not commanded."""
        n, rng, layout = len(which), self._rng, self._layout
        slab, route = rng.integers(0, len(layout.placements), n), rng.integers(0, len(layout.routes), n)
        scout = layout.scout.sample(n, rng)
        anywhere = free_poses(layout, slab, rng, apart_from=scout)
        anywhere[:, 2] /= 2  # looking ahead, within +- 90 degrees
        there = layout.corridor_at(*anywhere.T[:2])
        wrong = (there != NO_CORRIDOR) & (there != route)
        start = np.where(((rng.random(n) < FROM_SPAWN) | wrong)[:, None], layout.spawn.sample(n, rng), anywhere)
        self._arena.reset(which, start, slab, scout)
        self.route = np.where(which, route, self.route)
        self._entered = np.where(which, self._arena.corridor == self.route, self._entered)
        self._age[which] = 0


def train_executor(
    config: ExecutorConfig, seed: int, *, report: Callable[[float], None], encoder: Mapping[str, np.ndarray]
) -> dict:
    """Pretrains the controller behind a frozen encoder; returns its weights and learning curves.

    "curve.*" have one entry per update: obedient share of the episodes that ended, their number, entropy.
    "<look>.*" are the weights after each of `config.looks`.
    """
    rng, layout = Stream.EXECUTOR.generator(seed), load_layout(config.layout)
    device = config.device
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        policy = Executor(len(layout.routes)).to(device)
    generator = torch.Generator(device).manual_seed(seed)
    driving = Driving(layout, FrozenEncoder(encoder, device, config.precision), config.envs, rng)
    optimiser = torch.optim.Adam(policy.parameters(), lr=config.lr, eps=1e-5, fused=True)
    updates = max(1, config.steps // (config.rollout * config.envs))
    curves, kept = [], {}
    for i in range(updates):
        batch, ended, obedient = _collect(driving, policy, config, generator)
        statistics = ppo.update(policy, optimiser, batch, config.ppo, config.minibatch, rng)
        curves.append((obedient / max(ended, 1), ended, statistics.entropy))
        taken = (i + 1) * config.rollout * config.envs  # control steps
        if taken in config.looks:
            kept |= state_of(policy, str(taken))
        report((i + 1) / updates)
    weights = {k: v.cpu().numpy() for k, v in policy.state_dict().items()} | kept
    names = ("obedient", "episodes", "entropy")
    return weights | {
        f"curve.{name}": np.array(c, np.float32) for name, c in zip(names, zip(*curves, strict=True), strict=True)
    }


def _collect(driving: Driving, policy: Executor, config: ExecutorConfig, generator: torch.Generator):
    """A batch of `rollout` steps per environment with advantages, and the numbers of episodes that ended and obeyed."""
    steps, ended_count, obedient_count = [], 0, 0
    observation = driving.observe()
    for _ in range(config.rollout):
        with torch.no_grad():
            mean = policy.mean(observation)
            action = mean + policy.log_std.exp() * torch.randn(mean.shape, generator=generator, device=mean.device)
            log_prob, _, value = policy.evaluate(observation, action)
            rewards, obedient, terminated, ended, final = driving.step(action.cpu().numpy())
            following = policy.critic(final).squeeze(1)
        flags = (torch.from_numpy(a).to(mean.device) for a in (rewards.astype(np.float32), terminated, ended))
        steps.append(ppo.Step(observation, action, log_prob, value, following, *flags))
        ended_count, obedient_count = ended_count + ended.sum(), obedient_count + obedient.sum()
        observation = final
        if ended.any():
            restarted = np.flatnonzero(ended)
            places = torch.from_numpy(restarted).to(final.device)
            observation = final.index_copy(0, places, driving.observe(restarted))
    return ppo.batch_of(steps, config.ppo), int(ended_count), int(obedient_count)
