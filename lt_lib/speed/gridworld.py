"""What the tables buy in the gridworld: the same training, sample by sample and by tables, side by side on one core."""

from functools import partial

import numpy as np
import pandas as pd
import torch

from lt_lib import ppo
from lt_lib.comm.channel import Channel
from lt_lib.comm.messages import Sender
from lt_lib.envs.layout import SIDES, load_layout
from lt_lib.gridworld import table_ppo
from lt_lib.gridworld.map import GOAL_REWARD, HORIZON, SLAB_REWARD, STEP_REWARD, Grid
from lt_lib.gridworld.mappo import Inputs, TableTeam, Team, batch
from lt_lib.gridworld.patches import FrozenPatchEncoder
from lt_lib.gridworld.views import cells
from lt_lib.gridworld.walks import States, first_states, walk
from lt_lib.gridworld.wires import GRID_CONTENTS
from lt_lib.settings.gridworld import GridConfig
from lt_lib.speed.turns import taking_turns
from lt_lib.store.run import Result


def rates(config: GridConfig, encoder: Result, rounds: int = 2) -> pd.DataFrame:
    """Processor seconds per update of both ways (the median over rounds in which they take turns) and steps per second.

    plain   every step encodes both robots' patches, delivers the message and asks the policy; every sample of the
            update goes through the receiver and autograd (`ppo.update`)
    tables  what `gridworld.mappo.train_grid` does
    """
    grid = Grid(load_layout(config.layout))
    views = cells(grid, encoder)
    frozen, inputs = views.encoder, Inputs.of(grid, views, config.content)
    learners = {
        "plain loop": _Plain(grid, frozen, Team(inputs), config),
        "tables": _Tables(grid, TableTeam(inputs), config),
    }
    calls = {}
    for name, learner in learners.items():
        calls[name, "rollout (s)"] = learner.sample
        calls[name, "update (s)"] = partial(learner.improve, learner.sample())
    table = pd.Series(taking_turns(calls, rounds)).unstack(0)[list(learners)]
    table.loc["steps/s, learning included"] = config.envs * config.rollout / table.sum()
    return table


class _Learner:
    """A team, its optimiser and its environments."""

    def __init__(self, grid: Grid, team: Team, config: GridConfig):
        self.grid, self.team, self.config, self.rng = grid, team, config, np.random.default_rng(0)
        self.optimiser = torch.optim.Adam(team.parameters(), lr=config.lr, eps=1e-5, fused=True)
        self.states = first_states(grid, config.envs, self.rng)


class _Tables(_Learner):
    def sample(self):
        with torch.no_grad():
            log_probs, values = self.team.log_probs(), self.team.values()
        walks, self.states = walk(
            self.grid, log_probs.exp().numpy(), self.states, self.config.rollout, self.rng, self.config.latency
        )
        return batch(log_probs, values, walks, self.config.ppo)

    def improve(self, sampled) -> None:
        settings = self.config.ppo, self.config.minibatch, self.rng
        table_ppo.update(self.team, self.optimiser, *sampled, *settings)


class _Plain(_Learner):
    def __init__(self, grid: Grid, frozen: FrozenPatchEncoder, team: Team, config: GridConfig):
        super().__init__(grid, team, config)
        self.frozen, width = frozen, team.inputs.contents.shape[-1]
        self.channel = Channel((config.envs,), width, grid.layout.communication_radius, config.latency)

    @torch.no_grad()
    def sample(self) -> ppo.Batch:
        steps = [self._step() for _ in range(self.config.rollout)]
        seen, action, log_prob, value, reward, following, terminated, ended = (
            torch.stack(column) for column in zip(*steps, strict=True)
        )
        settings = self.config.ppo.gamma, self.config.ppo.lam
        advantage = ppo.advantages(reward, value, following, terminated, ended, *settings)
        return ppo.Batch(
            seen.flatten(0, 1),
            action.flatten(),
            log_prob.flatten(),
            advantage.flatten(),
            (advantage + value).flatten(),
        )

    def improve(self, sampled: ppo.Batch) -> None:
        ppo.update(self.team, self.optimiser, sampled, self.config.ppo, self.config.minibatch, self.rng)

    def _step(self):
        cell, slab, post, clock = self.states
        own = self.frozen.latent(self.grid.patches[cell, slab])
        policy = torch.distributions.Categorical(
            logits=self.team.actor(own, self._wire()[:, None], torch.from_numpy(clock >= self.config.latency)[:, None])
        )
        action = policy.sample()
        there = self.grid.following[cell, action.numpy()]
        arrived, blocked = self.grid.goal[there], self.grid.slab[slab, there]
        ended = arrived | blocked | (clock + 1 == HORIZON)
        seen = torch.from_numpy(np.stack([self.states.message(self.config.latency), cell, slab], axis=1))
        reward = np.where(arrived, GOAL_REWARD, np.where(blocked, SLAB_REWARD, STEP_REWARD)).astype(np.float32)
        values = [self.team.critic(torch.from_numpy(c * len(SIDES) + slab)) for c in (cell, there)]
        new = first_states(self.grid, len(cell), self.rng)
        self.states = States(*(np.where(ended, n, o) for n, o in zip(new, (there, slab, post, clock + 1), strict=True)))
        flags = torch.from_numpy(arrived | blocked), torch.from_numpy(ended)
        return seen, action, policy.log_prob(action), values[0], torch.from_numpy(reward), values[1], *flags

    def _wire(self):
        cell, slab, post, clock = self.states
        pose = np.pad(self.grid.centres[self.grid.posts[post]], ((0, 0), (0, 1)))
        frames = self.grid.patches[self.grid.posts[post], slab]
        sender = Sender(self.grid.layout, self.frozen, frames, pose, np.zeros((len(cell), 2)), slab)
        self.channel.send(clock, GRID_CONTENTS[self.config.content](sender), pose[:, :2])
        return self.channel.receive(clock, self.grid.centres[cell])
