"""The channel, identical for every content: anchor, range, one step of latency (Section Broadcast and anchor).

A message sent at step t - 1 arrives at step t, when its anchor is added. `CORRUPTIONS` are what can happen to the
wire on the way (Section Corruption controls); 'intact' is the channel as it is.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

ANCHOR = 2
LATENCY = 1  # control steps


def anchor(sender: Float[np.ndarray, "b 2"], receiver: Float[np.ndarray, "b 2"], radius: float) -> Float[Tensor, "b 2"]:
    """The sender's position relative to the receiver, in communication radii."""
    return torch.from_numpy((sender - receiver) / radius).float()


def deliver(
    content: Float[Tensor, "b c"],
    sender: Float[np.ndarray, "b 2"],
    receiver: Float[np.ndarray, "b 2"],
    radius: float,
) -> Float[Tensor, "b w"]:
    """The wire (b, 2 + c) as it reaches the receiver; all zeros from a sender farther away than `radius` metres."""
    offset = anchor(sender, receiver, radius)
    in_range = offset.norm(dim=1, keepdim=True) <= 1
    return torch.cat([offset, content], dim=1) * in_range


def intact(wire: Float[Tensor, "b w"], rng: np.random.Generator) -> Float[Tensor, "b w"]:
    return wire


def content_zeroed(wire: Float[Tensor, "b w"], rng: np.random.Generator) -> Float[Tensor, "b w"]:
    """The anchor alone."""
    return torch.cat([wire[:, :ANCHOR], torch.zeros_like(wire[:, ANCHOR:])], dim=1)


def wire_zeroed(wire: Float[Tensor, "b w"], rng: np.random.Generator) -> Float[Tensor, "b w"]:
    """Nothing, not even the anchor."""
    return torch.zeros_like(wire)


def sender_shuffled(wire: Float[Tensor, "b w"], rng: np.random.Generator) -> Float[Tensor, "b w"]:
    """A real content from another environment, never one's own; the anchor is still this environment's."""
    order = rng.permutation(len(wire))
    donor = np.empty_like(order)
    donor[order] = np.roll(order, 1)
    return torch.cat([wire[:, :ANCHOR], wire[donor, ANCHOR:]], dim=1)


def matched_noise(wire: Float[Tensor, "b w"], rng: np.random.Generator) -> Float[Tensor, "b w"]:
    """Gaussian noise with the mean and standard deviation of every content dimension over the batch."""
    content = wire[:, ANCHOR:]
    noise = torch.from_numpy(rng.standard_normal(content.shape)).float()
    return torch.cat([wire[:, :ANCHOR], content.mean(0) + content.std(0) * noise], dim=1)


CORRUPTIONS = {f.__name__: f for f in (intact, content_zeroed, wire_zeroed, sender_shuffled, matched_noise)}
