"""The route head trained live, its route redrawn every k control steps (Section Restoring temporal abstraction).

Once the route can change during an episode, the outcome depends on all its draws, so the episode bank no longer
applies: navigator, camera, frozen encoder and frozen executor are stepped while the head learns. With one draw per
episode (k = 0) the result equals that of `route.train_head` episode by episode, which checks everything here.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lt_lib import ppo
from lt_lib.comm.channel import ANCHOR, Channel
from lt_lib.comm.messages import CONTENT, CONTENTS, Sender
from lt_lib.comm.route_head import RouteHead
from lt_lib.envs.arena import HORIZON, Arena
from lt_lib.envs.camera import FastCamera
from lt_lib.envs.layout import SIDES, load_layout
from lt_lib.perception.encoder import FrozenEncoder
from lt_lib.perception.renewal import renew
from lt_lib.pixels.episodes import (
    ARRIVAL_REWARD,
    CONTACT_REWARD,
    Draws,
    Outcomes,
    Seats,
    held_out_draws,
    none_yet,
    record,
)
from lt_lib.pixels.executor import FrozenExecutor
from lt_lib.settings.pixels import RedrawConfig
from lt_lib.settings.ppo import PpoConfig
from lt_lib.settings.streams import Stream
from lt_lib.store.states import state_of


class Redraw(NamedTuple):
    """How often the route is drawn, and from what: the lower block of Table III, and an alternative reading of it."""

    content: str
    every: int  # control steps, the paper's k; 0: once
    credit: str  # a name in CREDITS
    role: str
    words: str


REDRAWS = {
    "k0": Redraw("latent", 0, "episode", "ours", "latent $z_t$, one draw ($k=0$)"),
    "k30": Redraw("latent", 30, "episode", "ours", "latent $z_t$, every 30 steps"),
    "k1": Redraw("latent", 1, "episode", "ours", "latent $z_t$, every step ($k=1$)"),
    "oracle_k1": Redraw("oracle", 1, "episode", "diagnostic", "oracle, every step ($k=1$)"),
    "k30_gae": Redraw("latent", 30, "gae", "ours", "every 30 steps, discounted credit"),
    "k1_gae": Redraw("latent", 1, "gae", "ours", "every step, discounted credit"),
}
SCENES = ("spawn", "scout", "commit_step", "held_out")  # the parts of an episode bank that live training needs
# Frames are encoded in multiples of this, so that a row's arithmetic does not depend on its neighbours'
FRAMES_AT_ONCE = 16
UNSEEN = 255  # not a palette index


class Decisions(NamedTuple):
    """The D draws of a batch of episodes, ordered by episode and then by time."""

    episode: Int[np.ndarray, " d"]
    wires: Float[Tensor, "d w"]
    routes: Int[Tensor, " d"]
    rewards: Float[np.ndarray, " d"]  # the team's, from this draw to the next


class FrameMemory:
    """The last frame of every row and the value computed from it, recomputed only if the frame has changed."""

    def __init__(self, rows: int, pixels: int):
        self._frames = np.full((rows, pixels * pixels), UNSEEN, np.uint8).view(np.uint64)
        self.made: Tensor | None = None  # (rows, width), zeros for a row that has had no frame

    def forget(self, which: Bool[np.ndarray, " n"]):
        self._frames.view(np.uint8)[which] = UNSEEN

    def recall(self, rows: Int[np.ndarray, " b"], frames, make: Callable) -> Float[Tensor, "b width"]:
        """The values computed from the frames (B, H, W) of some rows.

        make  computes them from positions in `rows`, a multiple of FRAMES_AT_ONCE
        """
        changed = np.empty(len(rows), bool)
        renew(self._frames, rows, frames.reshape(len(rows), -1).view(np.uint64), changed)
        new = np.flatnonzero(changed)
        if len(new):
            whole_blocks = np.resize(new, -(-len(new) // FRAMES_AT_ONCE) * FRAMES_AT_ONCE)
            made = make(whole_blocks)
            if self.made is None:
                self.made = made.new_zeros(len(self._frames), made.shape[1])
            self.made[rows[new]] = made[: len(new)]
        return self.made[rows]


class LiveArena:
    """Navigators driven by the frozen executor, and their scouts' messages, `config.envs` side by side."""

    def __init__(
        self,
        config: RedrawConfig,
        commit_step: int,
        encoder: Mapping[str, np.ndarray],
        executor: Mapping[str, np.ndarray],
    ):
        device = config.device
        self._layout, self._config, self._commit_step = load_layout(config.layout), config, commit_step
        radius = self._layout.communication_radius
        self._channel = Channel((config.envs,), CONTENT, radius, config.latency)
        self._arena, self._camera = Arena(self._layout, config.envs), FastCamera(self._layout)
        self._encoder = FrozenEncoder(encoder, device, config.precision)
        self._executor = FrozenExecutor(executor, device)
        self._own, self._sent = (FrameMemory(config.envs, self._camera.pixels) for _ in range(2))

    @torch.no_grad()
    def play(self, head: RouteHead, draws: Draws, slab, chance: Float[np.ndarray, "e d"]) -> tuple[Outcomes, Decisions]:
        """Plays E episodes from their draws to the goal or the time-out, redrawing every `config.every` steps.

        slab    (E,) 0 left, 1 right: the blocked corridor
        chance  uniform numbers: draw d of episode e goes right if chance[e, d] is below the head's probability.
                They belong to the episode, so it does not matter which row plays it, or when.
        """
        arena, seats = self._arena, Seats(self._config.envs, len(slab))
        outcome, log = none_yet(len(slab)), []
        rewards = np.zeros_like(chance)
        route = np.zeros(arena.n, np.int64)
        self._start(np.ones(arena.n, bool), draws, slab, seats)
        while seats.live.any():
            number = self._draw_number(seats.age)  # (n,)
            # a scout's message is computed only if the route is drawn when it arrives
            self._send(np.flatnonzero(seats.live & self._draws_at(seats.age + self._channel.latency)), seats.age)
            rows = np.flatnonzero(seats.live & self._draws_at(seats.age))  # (b,)
            if len(rows):
                wire = self._channel.receive(seats.age[rows], arena.pose[rows, :2], rows)  # (b, w)
                at = seats.episode[rows], number[rows]
                route[rows] = chance[at] < head.policy(wire).probs[:, 1].numpy()
                log.append((seats.episode[rows], wire, route[rows]))
            action = self._action(seats.live, route)  # (n, 3)
            arena.step(np.where(seats.age[:, None] < self._commit_step, 0.0, action), seats.live)
            seats.age += 1
            live, at = seats.live, (seats.episode[seats.live], number[seats.live])
            rewards[at] += ARRIVAL_REWARD * arena.reached[live] + CONTACT_REWARD * arena.contact[live]
            record(outcome, arena, seats)
            ended = live & (arena.reached | (seats.age >= HORIZON))
            if ended.any():
                self._start(seats.pass_on(ended), draws, slab, seats)
        return outcome, _ordered(log, rewards)

    def _draws_at(self, age: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        every, since = self._config.every, age - self._commit_step
        return (since == 0) | ((since > 0) & (since % every == 0) if every else False)

    def _draw_number(self, age) -> Int[np.ndarray, " n"]:
        """Index of the draw that each row follows, 0 before the first."""
        every = self._config.every or HORIZON
        return np.maximum(age - self._commit_step, 0) // every

    def _start(self, which: Bool[np.ndarray, " n"], draws: Draws, slab, seats: Seats):
        self._arena.reset(which, draws.spawn[seats.episode], slab[seats.episode], draws.scout[seats.episode])
        self._sent.forget(which)

    def _action(self, live: Bool[np.ndarray, " n"], route) -> Float[np.ndarray, "n 3"]:
        arena, rows = self._arena, np.flatnonzero(live)
        frames = self._camera.frames(arena.pose[rows], arena.slab[rows], arena.scout[rows, :2])
        self._own.recall(rows, frames, lambda picks: self._encoder.latent(frames[picks]))
        return self._executor.mean_action(self._own.made, route)

    def _send(self, rows: Int[np.ndarray, " b"], age: Int[np.ndarray, " n"]) -> None:
        """The scouts of some rows send what they see."""
        if not len(rows):
            return
        scout, slab = self._arena.scout[rows], self._arena.slab[rows]
        frames = self._camera.frames(scout, slab, self._arena.pose[rows, :2])
        still = np.zeros((len(rows), 2))
        content = CONTENTS[self._config.content]

        def sent(picks):
            return content(Sender(self._layout, self._encoder, frames[picks], scout[picks], still[picks], slab[picks]))

        self._channel.send(age[rows], self._sent.recall(rows, frames, sent), scout[:, :2], rows)


def draws_per_episode(every: int, commit_step: int) -> int:
    """Number of routes drawn in an episode that times out."""
    return -(-(HORIZON - commit_step) // every) if every else 1


def _ordered(log: list, rewards: Float[np.ndarray, "e d"]) -> Decisions:
    """The step-by-step log, regrouped by episode; a stable sort keeps each episode's draws in time order."""
    episode, wires, routes = zip(*log, strict=True)
    episode = np.concatenate(episode)
    order = np.argsort(episode, kind="stable")
    episode = episode[order]
    number = np.arange(len(order)) - np.searchsorted(episode, episode)
    routes = torch.from_numpy(np.concatenate(routes))[order]
    return Decisions(episode, torch.cat(wires)[order], routes, rewards[episode, number])


# --- credit assignment: advantages and value targets (D,) of the decisions
def whole_episode(decisions: Decisions, outcome: Outcomes, values: Float[Tensor, " d"], config: PpoConfig):
    """Credits every draw with its episode's whole undiscounted return, as for k = 0 (Section Route head)."""
    returns = torch.from_numpy(outcome.returns[decisions.episode]).float()
    return returns - values, returns


def generalised(decisions: Decisions, outcome: Outcomes, values: Float[Tensor, " d"], config: PpoConfig):
    """Generalised advantage estimates over the sequence of draws, discounted per draw; a time-out is terminal."""
    episode = decisions.episode
    time = np.arange(len(episode)) - np.searchsorted(episode, episode)
    reward, value = torch.zeros(2, time.max() + 1, len(outcome.success))
    reward[time, episode], value[time, episode] = torch.from_numpy(decisions.rewards).float(), values
    ended, again = torch.ones_like(reward, dtype=torch.bool), time > 0
    ended[time[again] - 1, episode[again]] = False
    following = torch.cat([value[1:], torch.zeros_like(value[:1])])
    gain = ppo.advantages(reward, value, following, ended, ended, config.gamma, config.lam)[time, episode]
    return gain, gain + values


CREDITS = {"episode": whole_episode, "gae": generalised}


def train_redrawn_head(
    config: RedrawConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    scenes: Mapping[str, np.ndarray],
    encoder: Mapping[str, np.ndarray],
    executor: Mapping[str, np.ndarray],
) -> dict:
    """Trains one head live on the training draws of the bank's `scenes` (`SCENES`); any content but raw.

    "head.*"           weights
    "optimal", "entered", "success", "contacts", "length" (episodes,) of the head's sampled choices, in order;
                       optimal when the corridor first entered is the slab-free one
    "entropy", "draws" (updates,) nats per draw, draws in the batch
    """
    how_often = (f"every {config.every}",) if config.every else ()  # one draw has the stream of `train_head`
    rng = Stream.HEAD.generator(seed, config.content, "intact", *how_often)
    commit_step = scenes["commit_step"]
    arena = LiveArena(config, commit_step, encoder, executor)
    spawn, scout = (scenes[name][held_out_draws(scenes) :] for name in ("spawn", "scout"))
    head = ppo.built(lambda: RouteHead(ANCHOR + CONTENT), rng)
    optimiser = torch.optim.Adam(head.parameters(), lr=config.lr, eps=1e-5, fused=True)
    episodes, updates = [], []
    for start in range(0, config.episodes, config.batch):
        n = min(config.batch, config.episodes - start)
        entry, slab = rng.integers(0, len(spawn), n), rng.integers(0, len(SIDES), n)
        chance = rng.random((n, draws_per_episode(config.every, commit_step)))
        outcome, decisions = arena.play(head, Draws(spawn[entry], scout[entry]), slab, chance)
        entropy = _improve(head, optimiser, outcome, decisions, config, rng)
        episodes.append({"optimal": outcome.entered == 1 - slab} | outcome._asdict())
        updates.append((entropy, len(decisions.routes)))
        report((start + n) / config.episodes)
    entropy, count = zip(*updates, strict=True)
    return (
        state_of(head, "head")
        | {name: np.concatenate([e[name] for e in episodes]) for name in episodes[0]}
        | {"entropy": np.array(entropy, np.float32), "draws": np.array(count)}
    )


def _improve(head, optimiser, outcome: Outcomes, decisions: Decisions, config: RedrawConfig, rng) -> float:
    """One PPO update on a batch of episodes; returns the entropy before it, nats per draw.

    A minibatch holds as many draws as `config.minibatch` episodes have on average, so that the number of gradient
    steps does not depend on how often the route is drawn.
    """
    with torch.no_grad():
        log_probs, entropy, values = head.evaluate(decisions.wires, decisions.routes)
    gain, returns = CREDITS[config.credit](decisions, outcome, values, config.ppo)
    batch = ppo.Batch(decisions.wires, decisions.routes, log_probs, gain, returns)
    minibatch = -(-len(returns) * config.minibatch // len(outcome.success))
    ppo.update(head, optimiser, batch, config.ppo, minibatch, rng)
    return entropy.mean().item()
