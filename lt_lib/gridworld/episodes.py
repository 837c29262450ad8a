"""Episodes of a frozen gridworld policy, with whatever happens to the wire (Section Corruption controls)."""

from collections.abc import Callable, Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lt_lib.comm.channel import CORRUPTIONS, Channel
from lt_lib.envs.layout import load_layout
from lt_lib.gridworld.map import HORIZON, Grid
from lt_lib.gridworld.mappo import Actor, Inputs
from lt_lib.gridworld.views import VIEWS
from lt_lib.gridworld.walks import States, first_states
from lt_lib.settings.base import LATENCY
from lt_lib.settings.gridworld import GridEvaluationConfig
from lt_lib.settings.streams import Stream
from lt_lib.store.states import restored

Choice = Callable[[Float[Tensor, "n 5"], np.random.Generator], Int[np.ndarray, " n"]]


def greedy(logits: Float[Tensor, "n 5"], rng: np.random.Generator) -> Int[np.ndarray, " n"]:
    """The likeliest action."""
    return logits.argmax(1).numpy()


def sampled(logits: Float[Tensor, "n 5"], rng: np.random.Generator) -> Int[np.ndarray, " n"]:
    """An action drawn from the policy, as in training."""
    cumulative = logits.softmax(1).cumsum(1).numpy()
    return (rng.random((len(logits), 1)) >= cumulative[:, :-1]).sum(1)


CHOICES = {f.__name__: f for f in (greedy, sampled)}


def evaluate_grid(
    config: GridEvaluationConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    policy: Mapping[str, np.ndarray],
    encoder: Mapping[str, np.ndarray],
) -> dict:
    """Plays a frozen policy under one wire condition, its actions greedy and, on the same starts, sampled.

    For each, named "greedy.*" and "sampled.*": "success", "length", "rerouted" (n,) and "cells" (n, 101) of the
    navigator, padded with the last; "slab" (n,) is the blocked corridor.
    """
    grid = Grid(load_layout(config.layout))
    inputs = Inputs.of(grid, VIEWS["cells"](grid, encoder), config.content)
    actor, result = read_actor(policy), {}
    for name, choose in CHOICES.items():
        rng = Stream.GRID_EVALUATION.generator(seed, config.content)
        starts = first_states(grid, config.episodes, rng)
        cells = play(grid, inputs, actor, starts, config.wire, choose, rng, config.latency)
        arrived = grid.goal[cells]
        ended = arrived | grid.slab[starts.slab[:, None], cells]
        length = np.where(ended.any(1), ended.argmax(1), HORIZON)
        result |= {
            f"{name}.success": arrived[:, -1],
            f"{name}.length": length,
            f"{name}.rerouted": rerouted(grid, cells),
            f"{name}.cells": cells.astype(np.int16),
        }
    return result | {"slab": starts.slab}


@torch.no_grad()
def play(
    grid: Grid,
    inputs: Inputs,
    actor: Actor,
    starts: States,
    wire: str,
    choose: Choice,
    rng: np.random.Generator,
    latency: int = LATENCY,
) -> Int[np.ndarray, "n t"]:
    """The navigator's cells, (n, 101); it stays where its episode ended.

    A corruption stays the same throughout an episode, as the true message of a stationary scout does: one donor, one
    draw of the noise.
    """
    cell, slab, message = starts.cell, torch.from_numpy(starts.slab), torch.from_numpy(starts.post + 1)
    seed, cells = int(rng.integers(2**32)), [starts.cell]
    sent, scout = inputs.contents[message, slab], grid.centres[grid.posts[starts.post]]  # (n, c), (n, 2)
    radius = grid.layout.communication_radius
    channel = Channel(
        (len(cell),),
        sent.shape[1],
        radius,
        latency,
        lambda wires: CORRUPTIONS[wire](wires, np.random.default_rng(seed)),
    )
    for step in range(HORIZON):
        where = torch.from_numpy(cell)
        channel.send(step, sent, scout)
        wires = channel.receive(step, grid.centres[cell])  # (n, w)
        present = inputs.present[message, where] & (step >= latency)
        action = choose(actor(inputs.own[where, slab], wires[:, None], present[:, None]), rng)
        ended = grid.goal[cell] | grid.slab[starts.slab, cell]
        cell = np.where(ended, cell, grid.following[cell, action])
        cells.append(cell)
    return np.stack(cells, axis=1)


def rerouted(grid: Grid, cells: Int[np.ndarray, "n t"]) -> Bool[np.ndarray, " n"]:
    """Whether an episode entered one corridor and then, before it ended, the other."""
    inside = [corridor.contains(*grid.centres.T)[cells] for corridor in grid.layout.routes]
    return np.logical_and(*(side.any(1) for side in inside))


def read_actor(policy: Mapping[str, np.ndarray]) -> Actor:
    """The trained actor in a result of `train_grid`."""
    width = policy["actor.receiver.value.weight"].shape[1]
    return restored(Actor(width), policy, "actor").requires_grad_(False)
