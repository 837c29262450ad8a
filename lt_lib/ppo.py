"""Proximal policy optimisation, the one update that every policy here shares (Section Implementation).

Clip 0.2, four epochs, entropy coefficient 0.01, gamma 0.99, lambda 0.95, the same for every seed and condition.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor, nn

from lt_lib.settings.ppo import PpoConfig

Module = TypeVar("Module", bound=nn.Module)
MAX_GRADIENT_NORM = 0.5
VALUE_COEFFICIENT = 0.5


@runtime_checkable
class Policy(Protocol):
    """A policy that PPO can improve: an nn.Module with one method."""

    def evaluate(self, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log-probability of the actions, entropy, and value, each (B,)."""

    def parameters(self): ...


class Batch(NamedTuple):
    """What was sampled, flattened to B steps."""

    observations: Shaped[Tensor, "b d"]  # floats, or the gridworld's rows of tables
    actions: Tensor  # (B,) categorical or (B, A) continuous
    log_probs: Float[Tensor, " b"]
    advantages: Float[Tensor, " b"]
    returns: Float[Tensor, " b"]


class Statistics(NamedTuple):
    """Means over an update's minibatches."""

    policy_loss: float
    value_loss: float
    entropy: float
    clipped: float  # share of ratios outside the clip


class Step(NamedTuple):
    """One step of n environments side by side; arguments of `advantages` are named as there."""

    observations: Shaped[Tensor, "n d"]
    actions: Tensor
    log_probs: Float[Tensor, " n"]
    values: Float[Tensor, " n"]
    following: Float[Tensor, " n"]
    rewards: Float[Tensor, " n"]
    terminated: Bool[Tensor, " n"]
    ended: Bool[Tensor, " n"]


def built(make: Callable[[], Module], rng: np.random.Generator) -> Module:
    """What `make` makes, its weights drawn from a generator and not from torch's global one."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(2**31)))
        return make()


def mlp(inputs: int, outputs: int, gain: float, hidden: int = 128) -> nn.Sequential:
    """Two tanh layers, orthogonally initialised, the last layer by `gain`."""
    layers = [nn.Linear(inputs, hidden), nn.Tanh(), nn.Linear(hidden, hidden), nn.Tanh(), nn.Linear(hidden, outputs)]
    for layer, scale in zip(layers[::2], (np.sqrt(2), np.sqrt(2), gain), strict=True):
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)


def batch_of(steps: Sequence[Step], config: PpoConfig) -> Batch:
    """Consecutive steps, with their advantages, as one batch."""
    taken = Step(*(torch.stack(column) for column in zip(*steps, strict=True)))  # each (t, n, ...)
    gain = advantages(
        taken.rewards, taken.values, taken.following, taken.terminated, taken.ended, config.gamma, config.lam
    )
    flat = (taken.observations, taken.actions, taken.log_probs, gain, gain + taken.values)
    return Batch(*(column.flatten(0, 1) for column in flat))


def advantages(
    rewards: Float[Tensor, "t n"],
    values: Float[Tensor, "t n"],
    following: Float[Tensor, "t n"],
    terminated: Bool[Tensor, "t n"],
    ended: Bool[Tensor, "t n"],
    gamma: float,
    lam: float,
) -> Float[Tensor, "t n"]:
    """Generalised advantage estimates.

    following   value of the state that a step led to, before any reset: a time-out bootstraps from it
    terminated  the episode ended there for good, so nothing follows
    ended       terminated or timed out: no credit flows across
    """
    delta = rewards + gamma * following * ~terminated - values
    out, running = torch.zeros_like(delta), torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        running = delta[t] + gamma * lam * running * ~ended[t]
        out[t] = running
    return out


def update(
    policy: Policy,
    optimiser: torch.optim.Optimizer,
    batch: Batch,
    config: PpoConfig,
    minibatch: int,
    rng: np.random.Generator,
) -> Statistics:
    """`config.epochs` passes over the batch in shuffled minibatches; improves `policy` in place.

    Advantages are standardised over the whole batch, so a leftover minibatch of one is harmless.
    """
    n = len(batch.returns)
    advantage = (batch.advantages - batch.advantages.mean()) / (batch.advantages.std(correction=0) + 1e-8)
    totals = []
    for _ in range(config.epochs):
        order = torch.from_numpy(rng.permutation(n)).to(batch.returns.device)
        for pick in order.split(minibatch):
            log_prob, entropy, value = policy.evaluate(batch.observations[pick], batch.actions[pick])
            ratio = (log_prob - batch.log_probs[pick]).exp()
            surrogate = clipped_surrogate(ratio, advantage[pick], config.clip)
            value_loss = (value - batch.returns[pick]).square().mean()
            loss = -surrogate.mean() + VALUE_COEFFICIENT * value_loss - config.entropy * entropy.mean()
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), MAX_GRADIENT_NORM)
            optimiser.step()
            outside = ((ratio - 1).abs() > config.clip).float().mean()
            totals.append(torch.stack([-surrogate.mean(), value_loss, entropy.mean(), outside]).detach())
    return Statistics(*torch.stack(totals).mean(0).tolist())


def clipped_surrogate(ratio: Float[Tensor, " b"], advantage: Float[Tensor, " b"], clip: float) -> Float[Tensor, " b"]:
    """min(ratio * A, clip(ratio, 1 - clip, 1 + clip) * A)."""
    return torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage)
