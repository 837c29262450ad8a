"""MAPPO in the gridworld (Sections Implementation, Gridworld): one actor for all, one critic that sees the truth.

The scout stands still whatever it samples, so its steps are masked from the update: they are not in the batch. The
critic knows the slab's placement, the actor does not. All settings are the same for every content.

There are few distinct inputs (message, cell, placement), so `TableTeam` computes each once and looks samples up; its
updates are those of `Team`, which computes every sample.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from lt_lib import ppo
from lt_lib.comm.channel import heard
from lt_lib.comm.receiver import Receiver
from lt_lib.envs.layout import SIDES, load_layout
from lt_lib.gridworld import table_ppo
from lt_lib.gridworld.map import MOVES, Grid
from lt_lib.gridworld.views import VIEWS, Views
from lt_lib.gridworld.walks import Walks, first_states, walk
from lt_lib.gridworld.wires import anchors, contents_sent
from lt_lib.perception.encoder import LATENT
from lt_lib.settings.gridworld import GridConfig
from lt_lib.settings.ppo import PpoConfig
from lt_lib.settings.streams import Stream
from lt_lib.store.states import state_of

WIDTH = 64  # of every hidden layer


class Actor(nn.Module):
    """The robot's own latent and the messages it has received to the logits of five actions."""

    def __init__(self, wire: int, value_gain: float = 0.0):
        super().__init__()
        self.embed = nn.Sequential(nn.Linear(LATENT, WIDTH), nn.Tanh())
        self.receiver = Receiver(WIDTH, wire, WIDTH, value_gain)
        self.hidden = nn.Sequential(nn.Linear(2 * WIDTH, WIDTH), nn.Tanh())
        self.logits = nn.Linear(WIDTH, len(MOVES))
        nn.init.zeros_(self.logits.weight)
        nn.init.zeros_(self.logits.bias)

    def forward(
        self, own: Float[Tensor, "b 64"], wires: Float[Tensor, "b n w"], present: Bool[Tensor, "b n"]
    ) -> Float[Tensor, "b 5"]:
        ego = self.embed(own)
        pooled = self.receiver(ego, wires, present)
        return self.logits(self.hidden(torch.cat([ego, pooled], dim=1)))


class Critic(nn.Module):
    """The value of a joint one-hot of cell and placement, by its index; one hidden layer."""

    def __init__(self, states: int):
        super().__init__()
        self.hidden = nn.Embedding(states, WIDTH)  # a linear layer on the one-hot
        self.value = nn.Linear(WIDTH, 1)

    def forward(self, state: Int[Tensor, " b"]) -> Float[Tensor, " b"]:
        return self.value(self.hidden(state).tanh()).squeeze(1)


class Inputs(NamedTuple):
    """What the actor reads, by message, cell and placement of the slab.

    Message 0 is none, before the first has arrived; message m is that of a scout at post m - 1.
    """

    own: Float[Tensor, "p slab 64"]
    anchors: Float[Tensor, "m p 2"]
    contents: Float[Tensor, "m slab c"]
    present: Bool[Tensor, "m p"]

    @classmethod
    def of(cls, grid: Grid, views: Views, content: str) -> "Inputs":
        seen = views.own.reshape(-1, *views.own.shape[2:])  # (p * slab, h, w)
        own = views.encoder.latent(seen).reshape(len(grid.cells), len(SIDES), LATENT)
        where, sent = anchors(grid), contents_sent(grid, views, content)
        return cls(own, *(torch.cat([torch.zeros_like(x[:1]), x]) for x in (where, sent, heard(where))))

    def wires(self, observations: Int[Tensor, "b 3"]) -> Float[Tensor, "b w"]:
        message, cell, slab = observations.unbind(1)
        return torch.cat([self.anchors[message, cell], self.contents[message, slab]], dim=1)


class Team(nn.Module):
    """Actor and critic as PPO's policy; observations (B, 3) are rows of (message, cell, slab)."""

    def __init__(self, inputs: Inputs, value_gain: float = 0.0):
        super().__init__()
        self.inputs = inputs
        states, width = inputs.own.shape[0] * len(SIDES), inputs.anchors.shape[-1] + inputs.contents.shape[-1]
        self.actor, self.critic = Actor(width, value_gain), Critic(states)

    def logits(self, observations: Int[Tensor, "b 3"]) -> Float[Tensor, "b 5"]:
        message, cell, slab = observations.unbind(1)
        wires, present = self.inputs.wires(observations), self.inputs.present[message, cell]
        return self.actor(self.inputs.own[cell, slab], wires[:, None], present[:, None])

    def evaluate(self, observations: Int[Tensor, "b 3"], actions: Int[Tensor, " b"]):
        """Log-probability, entropy and value, each (b,)."""
        policy = torch.distributions.Categorical(logits=self.logits(observations))
        states = observations[:, 1] * len(SIDES) + observations[:, 2]
        return policy.log_prob(actions), policy.entropy(), self.critic(states)


class TableTeam(Team):
    """The same functions of the same parameters, each distinct input computed once per update.

    One sender's attention is 1 or 0, so what the hidden layer adds up is linear in latent, anchor and content: each is
    computed for its own few values, and only their sum for every combination.
    """

    def log_probs(self) -> Float[Tensor, "m p slab 5"]:
        """Of the five actions, for every input."""
        hidden, inputs, width = self.actor.hidden[0], self.inputs, self.inputs.anchors.shape[-1]
        of_ego, of_pooled = hidden.weight.split(WIDTH, dim=1)
        of_anchor, of_content = (of_pooled @ self.actor.receiver.value.weight).split(
            [width, inputs.contents.shape[-1]], dim=1
        )
        ego = self.actor.embed(inputs.own) @ of_ego.T + hidden.bias  # (p, slab, 64)
        anchor, content = inputs.anchors @ of_anchor.T, inputs.contents @ of_content.T  # (m, p, 64), (m, slab, 64)
        pooled = (anchor[:, :, None] + content[:, None]) * inputs.present[:, :, None, None]
        return self.actor.logits((ego + pooled).tanh()).log_softmax(dim=-1)

    def values(self) -> Float[Tensor, "p slab"]:
        states = torch.arange(self.inputs.own.shape[0] * len(SIDES))
        return self.critic(states).reshape(-1, len(SIDES))


def train_grid(
    config: GridConfig, seed: int, *, report: Callable[[float], None], encoder: Mapping[str, np.ndarray]
) -> dict:
    """Trains one receiver; returns its weights and what became of every training episode.

    "actor.*"                   weights
    "success", "length"         (episodes,) of sampled actions, in the order in which they ended
    "ended"                     (updates,) episodes that had ended after each update's rollout
    "entropy", "value_loss"     (updates,) nats, squared reward
    """
    grid, rng = Grid(load_layout(config.layout)), Stream.GRID_POLICY.generator(seed, config.content, config.view)
    inputs = Inputs.of(grid, VIEWS[config.view](grid, encoder), config.content)
    return learn(ppo.built(lambda: TableTeam(inputs, config.value_gain), rng), grid, config, rng, report)


def learn(
    team: TableTeam, grid: Grid, config: GridConfig, rng: np.random.Generator, report: Callable[[float], None]
) -> dict:
    """Trains a team; returns what `train_grid` does."""
    optimiser = torch.optim.Adam(team.parameters(), lr=config.lr, eps=1e-5, fused=True)
    states, updates, success, length, ended = first_states(grid, config.envs, rng), [], [], [], []
    total = -(-config.steps // (config.envs * config.rollout))
    for update in range(total):
        with torch.no_grad():
            log_probs, values = team.log_probs(), team.values()
        walks, states = walk(grid, log_probs.exp().numpy(), states, config.rollout, rng, config.latency)
        rows, sampled = batch(log_probs, values, walks, config.ppo)
        statistics = table_ppo.update(team, optimiser, rows, sampled, config.ppo, config.minibatch, rng)
        success.append(walks.arrived[walks.ended])
        length.append(walks.length[walks.ended])
        ended.append(walks.ended.sum())
        updates.append((statistics.entropy, statistics.value_loss))
        report((update + 1) / total)
    return state_of(team.actor, "actor") | {
        "success": np.concatenate(success),
        "length": np.concatenate(length).astype(np.int16),
        "ended": np.cumsum(ended),
        "entropy": np.array([entropy for entropy, _ in updates], np.float32),
        "value_loss": np.array([loss for _, loss in updates], np.float32),
    }


def batch(
    log_probs: Float[Tensor, "m p slab 5"], values: Float[Tensor, "p slab"], walks: Walks, config: PpoConfig
) -> tuple[Int[np.ndarray, "b 2"], ppo.Batch]:
    """Walked steps with their advantages, and their rows in the two tables.

    A time-out bootstraps from the cell that it ended in.
    """
    places = np.stack([walks.message, walks.cell, walks.slab], axis=-1).reshape(-1, 3)  # (t * n, 3)
    in_policy = np.ravel_multi_index(places.T, log_probs.shape[:3])  # (t * n,) of m * p * slab
    in_critic = np.ravel_multi_index(places.T[1:], values.shape)  # (t * n,) of p * slab
    rows = np.stack([in_policy, in_critic], axis=1)  # (t * n, 2)
    cell, slab, following, action, reward, terminated, ended = (
        torch.from_numpy(getattr(walks, name))
        for name in ("cell", "slab", "following", "action", "reward", "terminated", "ended")
    )
    now, after = values[cell, slab], values[following, slab]  # (t, n)
    advantage = ppo.advantages(reward, now, after, terminated, ended, config.gamma, config.lam)
    chosen = log_probs.flatten(0, 2)[torch.from_numpy(in_policy), action.flatten()]  # (t * n,)
    returns = (advantage + now).flatten()  # (t * n,)
    return rows, ppo.Batch(torch.from_numpy(places), action.flatten(), chosen, advantage.flatten(), returns)
