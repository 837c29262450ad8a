"""`learners.ppo.update` for a policy whose inputs are few: the same steps, summed over samples before autograd.

A sample enters the loss through one entry of the table of log-probabilities and one of the table of values. The loss's
gradient in those tables is written out below; autograd takes it from there to the parameters, once per update and
not once per sample. A test compares the parameters after an update with those of `ppo.update`.
"""

from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from lt_lib import ppo
from lt_lib.envs.compiled import compiled
from lt_lib.settings.ppo import PpoConfig


@runtime_checkable
class Tables(Protocol):
    """An nn.Module whose every output fits into two tables."""

    def log_probs(self) -> Tensor:
        """Of all actions, for every input: (..., a)."""

    def values(self) -> Tensor:
        """Of every state: (...)."""

    def parameters(self): ...


def update(
    tables: Tables,
    optimiser: torch.optim.Optimizer,
    rows: Int[np.ndarray, "b 2"],
    batch: ppo.Batch,
    config: PpoConfig,
    minibatch: int,
    rng: np.random.Generator,
) -> ppo.Statistics:
    """`config.epochs` passes over the batch in shuffled minibatches; improves `tables` in place.

    rows  of every sample: the input's place among the flattened log-probabilities, the state's among the values
    """
    n = len(batch.returns)
    advantage = (batch.advantages - batch.advantages.mean()) / (batch.advantages.std(correction=0) + 1e-8)
    samples = [x.numpy() for x in (batch.actions, batch.log_probs, advantage, batch.returns)]
    totals = []
    for _ in range(config.epochs):
        order = rng.permutation(n)
        for pick in np.split(order, range(minibatch, n, minibatch)):
            log_probs, values = tables.log_probs(), tables.values()
            flat = log_probs.detach().flatten(0, -2).numpy(), values.detach().flatten().numpy()
            gradients, statistics = _gradient(*flat, rows[pick], *(x[pick] for x in samples), *_weights(config))
            optimiser.zero_grad()
            torch.autograd.backward(
                [log_probs, values],
                [torch.from_numpy(g).view_as(x) for g, x in zip(gradients, (log_probs, values), strict=True)],
            )
            torch.nn.utils.clip_grad_norm_(tables.parameters(), ppo.MAX_GRADIENT_NORM)
            optimiser.step()
            totals.append(statistics)
    return ppo.Statistics(*np.mean(totals, axis=0).tolist())


def _weights(config: PpoConfig) -> tuple[float, float, float]:
    return config.clip, ppo.VALUE_COEFFICIENT, config.entropy


@compiled()
def _gradient(log_probs, values, rows, actions, old, advantages, returns, clip, value_weight, entropy_weight):
    """Of the PPO loss in both tables, and its parts: policy loss, value loss, entropy, share of ratios clipped."""
    by_log_prob, by_value, n = np.zeros_like(log_probs), np.zeros_like(values), len(actions)
    policy_loss, value_loss, entropy, outside = 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        row, state = rows[i]
        ratio, advantage = np.exp(log_probs[row, actions[i]] - old[i]), advantages[i]
        clipped = min(max(ratio, 1 - clip), 1 + clip)
        policy_loss -= min(ratio * advantage, clipped * advantage) / n
        outside += (abs(ratio - 1) > clip) / n
        if (ratio <= 1 + clip) if advantage > 0 else (ratio >= 1 - clip):  # else the clipped one counts, which is flat
            by_log_prob[row, actions[i]] -= ratio * advantage / n
        error = values[state] - returns[i]
        value_loss += error**2 / n
        by_value[state] += value_weight * 2 * error / n
        for a in range(log_probs.shape[1]):
            p = np.exp(log_probs[row, a])
            entropy -= p * log_probs[row, a] / n
            by_log_prob[row, a] += entropy_weight * p * (log_probs[row, a] + 1) / n
    return (by_log_prob, by_value), (policy_loss, value_loss, entropy, outside)
