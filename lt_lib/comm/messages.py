"""Message contents (Table I): one function each, from what the sender has to 64 floats.

To add one, write a function and list it in CONTENTS.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from lt_lib.envs.arena import CONTROL_HZ
from lt_lib.envs.camera import network_input
from lt_lib.envs.layout import Layout
from lt_lib.perception.encoder import ACTION, LATENT, FrozenEncoder

CONTENT = LATENT  # floats, every content but raw
PATH = CONTENT // 2 - 1  # points of the constant-velocity path besides the position


class Sender(NamedTuple):
    """What b senders know when they send.

    `velocity` is in m/s, zero for a stationary scout; `slab` is the true placement of the slabs (with two corridors, 0
    left, 1 right), for messages by hand only.
    """

    layout: Layout
    encoder: FrozenEncoder
    frames: UInt8[np.ndarray, "b h w"]
    pose: Float[np.ndarray, "b 3"]
    velocity: Float[np.ndarray, "b 2"]
    slab: Int[np.ndarray, " b"]


def floor(sender: Sender) -> Float[Tensor, "b 64"]:
    """Nothing."""
    return torch.zeros(len(sender.pose), CONTENT)


def position(sender: Sender) -> Float[Tensor, "b 64"]:
    """(x, y) in communication radii, zero-padded."""
    return _padded(sender.pose[:, :2] / sender.layout.communication_radius)


def trajectory(sender: Sender) -> Float[Tensor, "b 64"]:
    """(x, y) and the constant-velocity path of the next 31 control steps, in communication radii."""
    times = np.arange(PATH + 1)[:, None] / CONTROL_HZ
    path = sender.pose[:, None, :2] + times * sender.velocity[:, None]  # (b, 32, 2)
    return _padded(path.reshape(len(path), -1) / sender.layout.communication_radius)


def latent(sender: Sender) -> Float[Tensor, "b 64"]:
    """E(o): the normalised latent of the sender's own frame."""
    return sender.encoder.latent(sender.frames).cpu()


def predicted(sender: Sender) -> Float[Tensor, "b 64"]:
    """P(E(o), a): the latent that the sender expects next; a stationary sender's action is zero."""
    return sender.encoder.predicted(sender.frames, torch.zeros(len(sender.frames), ACTION)).cpu()


def raw(sender: Sender) -> Float[Tensor, "b 12288"]:
    """The frame itself, in the encoder's own input scaling."""
    return torch.from_numpy(network_input(sender.frames)).flatten(1)


def oracle(sender: Sender) -> Float[Tensor, "b 64"]:
    """The true hazard bit, zero-padded."""
    return _padded(sender.slab[:, None])


def half(sender: Sender) -> Float[Tensor, "b 64"]:
    """One bit by hand: whether a corridor of the left half is free, zero-padded."""
    free = ~sender.layout.blocks[sender.slab]  # (b, c)
    return _padded(free[:, : free.shape[1] // 2].any(axis=1)[:, None])


def state(sender: Sender) -> Float[Tensor, "b 64"]:
    """The placement's number in binary, by a hand that knows the task, zero-padded."""
    bits = max(1, (len(sender.layout.placements) - 1).bit_length())
    return _padded(sender.slab[:, None] >> np.arange(bits) & 1)


def _padded(values) -> Float[Tensor, "b 64"]:
    out = torch.zeros(len(values), CONTENT)
    out[:, : values.shape[1]] = torch.from_numpy(values)
    return out


class Condition(NamedTuple):
    """A row of Table I: what is sent, what happens to the wire, and its role in the comparison."""

    content: str
    wire: str
    role: str
    words: str


CONTENTS = {f.__name__: f for f in (floor, position, trajectory, latent, predicted, raw, oracle, half, state)}
CONDITIONS = {
    "latent": Condition("latent", "intact", "ours", "latent $z_t$"),
    "predicted": Condition("predicted", "intact", "ours", r"predicted $\hat{z}_{t+1}$"),
    "oracle": Condition("oracle", "intact", "diagnostic", "oracle (noiseless bit)"),
    "raw": Condition("raw", "intact", "upper bound", "raw observation"),
    "floor": Condition("floor", "intact", "lower bound", "floor (anchor + zeros)"),
    "zero_wire": Condition("floor", "wire_zeroed", "lower bound", "floor, whole wire zeroed"),
    "position": Condition("position", "intact", "kinematic", "position"),
    "trajectory": Condition("trajectory", "intact", "kinematic", "trajectory"),
    "half": Condition("half", "intact", "diagnostic", "one bit: left half or right"),
    "state": Condition("state", "intact", "diagnostic", "the whole state by hand"),
}
