"""The channel, the same for every content: anchor, range, latency, loss (Section Broadcast and anchor).

`CORRUPTIONS` are what can happen to a wire in transit (Section Corruption controls); 'intact' changes nothing.
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lt_lib.settings.base import LATENCY

ANCHOR = 2  # floats
NEVER = np.iinfo(np.int64).min  # marks a slot in which nothing was sent


class Channel:
    """Messages in flight from many senders side by side, each to its own receiver.

    A message sent at step t arrives at step t + latency and at no other. The anchor is the sender's position at sending
    relative to the receiver's at arrival, in communication radii. The wire is zeros for a sender farther away than the
    radius and for one whose message has not arrived or is lost.

    senders  shape of the senders, (b,) or, if each receiver hears n of them, (b, n)
    width    floats of the content
    radius   metres
    latency  control steps
    corrupt  what happens to the wires (..., 2 + width) of one step in transit
    lost     says of some rows which of the messages that they send now are lost; `comm.loss`. The paper loses none
    """

    def __init__(
        self,
        senders: tuple[int, ...],
        width: int,
        radius: float,
        latency: int = LATENCY,
        corrupt: Callable[[Tensor], Tensor] | None = None,
        lost: Callable[[Int[np.ndarray, " b"]], Bool[np.ndarray, "b ..."]] | None = None,
    ):
        self.latency, self.senders = latency, senders[0]
        self._radius, self._corrupt, self._lost = radius, corrupt, lost
        slots = latency + 1  # steps in flight at once; a step's slot is its remainder
        self._content = torch.zeros(slots, *senders, width)
        self._sender = np.zeros((slots, *senders, 2))
        self._sent_at = np.full((slots, *senders), NEVER)

    def send(
        self,
        step: int | Int[np.ndarray, " b"],
        content: Float[Tensor, "b *n c"],
        sender: Float[np.ndarray, "b *n 2"],
        rows: Int[np.ndarray, " b"] | None = None,
    ) -> None:
        """Sends contents at one step, or one step per row, replacing anything sent at that step before.

        rows  the rows that send, all by default
        """
        slot, rows = self._slots(step, rows)
        self._content[slot, rows], self._sender[slot, rows] = content, sender
        self._sent_at[slot, rows] = self._as_senders(step, rows)
        if self._lost:
            self._sent_at[slot, rows] = np.where(self._lost(rows), NEVER, self._sent_at[slot, rows])

    def receive(
        self,
        step: int | Int[np.ndarray, " b"],
        receiver: Float[np.ndarray, "b 2"],
        rows: Int[np.ndarray, " b"] | None = None,
    ) -> Float[Tensor, "b *n w"]:
        """The wires that reach receivers at their positions at a step."""
        sent_at = step - self.latency
        slot, rows = self._slots(sent_at, rows)
        sender = self._sender[slot, rows]  # (b, *n, 2)
        others = (1,) * (sender.ndim - 2)
        offset = anchor(sender, receiver.reshape(len(receiver), *others, 2), self._radius)
        wire = torch.cat([offset, self._content[slot, rows]], dim=-1)
        if self._corrupt:
            wire = self._corrupt(wire.flatten(0, -2)).reshape(wire.shape)
        arrived = torch.from_numpy(self._sent_at[slot, rows] == self._as_senders(sent_at, rows))
        return wire * (arrived & heard(offset))[..., None]

    def forget(self) -> None:
        """Loses whatever is in flight: a new episode begins."""
        self._sent_at[:] = NEVER

    def _slots(self, step, rows) -> tuple[np.ndarray, np.ndarray]:
        rows = np.arange(self._sent_at.shape[1]) if rows is None else rows
        return np.zeros_like(rows) + step % (self.latency + 1), rows

    def _as_senders(self, step, rows) -> np.ndarray:
        """A step, or one per row, in a shape that broadcasts over each row's senders."""
        return (np.zeros_like(rows) + step).reshape(-1, *(1,) * (self._sent_at.ndim - 2))


def anchor(
    sender: Float[np.ndarray, "b *n 2"], receiver: Float[np.ndarray, "b *m 2"], radius: float
) -> Float[Tensor, "b *n 2"]:
    """The sender's position relative to the receiver, in communication radii."""
    return torch.from_numpy((sender - receiver) / radius).float()


def heard(anchor: Float[Tensor, "*b 2"]) -> Bool[Tensor, "*b"]:
    """Whether the receiver is within the sender's communication radius."""
    return anchor.norm(dim=-1) <= 1


def measured_latency(latency: int) -> int:
    """Control steps until a channel of this latency delivers an impulse sent at one step amid silence.

    Raises ValueError unless it arrives at exactly one step.
    """
    steps, impulse, here = 2 * latency + 4, latency + 1, np.zeros((1, 2))
    channel, shown = Channel((1,), 1, 1.0, latency), []
    for step in range(steps):
        channel.send(step, torch.full((1, 1), float(step == impulse)), here)
        shown.append(channel.receive(step, here)[0, -1].item())
    (seen,) = np.flatnonzero(shown)
    return int(seen - impulse)


def intact(wire: Float[Tensor, "b w"], rng: np.random.Generator) -> Float[Tensor, "b w"]:
    return wire


def content_zeroed(wire: Float[Tensor, "b w"], rng: np.random.Generator) -> Float[Tensor, "b w"]:
    """The anchor alone."""
    return torch.cat([wire[:, :ANCHOR], torch.zeros_like(wire[:, ANCHOR:])], dim=1)


def wire_zeroed(wire: Float[Tensor, "b w"], rng: np.random.Generator) -> Float[Tensor, "b w"]:
    """Nothing, not even the anchor."""
    return torch.zeros_like(wire)


def sender_shuffled(wire: Float[Tensor, "b w"], rng: np.random.Generator) -> Float[Tensor, "b w"]:
    """A real content from another environment, never its own; the anchor is still this environment's."""
    order = rng.permutation(len(wire))
    donor = np.empty_like(order)
    donor[order] = np.roll(order, 1)
    return torch.cat([wire[:, :ANCHOR], wire[donor, ANCHOR:]], dim=1)


def matched_noise(wire: Float[Tensor, "b w"], rng: np.random.Generator) -> Float[Tensor, "b w"]:
    """Gaussian noise with the mean and standard deviation of every content dimension over the batch."""
    content = wire[:, ANCHOR:]
    noise = torch.from_numpy(rng.standard_normal(content.shape)).float()
    return torch.cat([wire[:, :ANCHOR], content.mean(0) + content.std(0) * noise], dim=1)


def anchor_zeroed(wire: Float[Tensor, "b w"], rng: np.random.Generator) -> Float[Tensor, "b w"]:
    """The content alone, which then says nothing about where its sender stands."""
    return torch.cat([torch.zeros_like(wire[:, :ANCHOR]), wire[:, ANCHOR:]], dim=1)


CORRUPTIONS = {f.__name__: f for f in (intact, content_zeroed, wire_zeroed, sender_shuffled, matched_noise)}
WIRES = CORRUPTIONS | {anchor_zeroed.__name__: anchor_zeroed}  # and what a head can be trained on besides
