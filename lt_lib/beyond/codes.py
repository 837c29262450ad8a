"""What a scout says about its picture, in how many bits, and what of it comes out at the receiver."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from lt_lib.comm.codec import WIDEST, Codec, fit_codec, jpeg
from lt_lib.comm.messages import CONTENT
from lt_lib.envs.camera import colours
from lt_lib.envs.layout import Layout
from lt_lib.perception.frames import random_rollouts
from lt_lib.perception.pictures import PictureEncoder
from lt_lib.settings.beyond import CodeConfig
from lt_lib.settings.streams import Stream

FITTED = 128, 32  # random rollouts and their length: the frames that a codec is fitted on


class View(NamedTuple):
    """What n scouts see, and what their teams' designers know."""

    layout: Layout
    encoder: PictureEncoder
    pictures: UInt8[np.ndarray, "n h w 3"]
    slab: Int[np.ndarray, " n"]  # the placement, for messages by hand alone


class Messages(NamedTuple):
    """What comes out at the receiver, and the size in bits of what was sent, without its anchor."""

    contents: Float[Tensor, "n c"]
    bits: Int[np.ndarray, " n"]


def latent(code: CodeConfig, view: View) -> Messages:
    """The latent, its first principal directions alone or all its floats, each rounded or not."""
    codec = codec_of(code, view.layout, view.encoder)
    decoded = codec.decode(codec.encode(view.encoder.latents(view.pictures)))
    return Messages(torch.from_numpy(decoded).float(), np.full(len(decoded), codec.bits))


def codec_of(code: CodeConfig, layout: Layout, encoder: PictureEncoder) -> Codec:
    """Fitted on the latents of random rollouts in the scene, as the encoder was trained on, without label or reward.

    The latent as it is needs no frames, and most links carry it so.
    """
    if (code.directions, code.bits) == (CONTENT, WIDEST):
        return Codec(None, None, CONTENT)
    rollouts = random_rollouts(layout, *FITTED, Stream.RADIO.generator(0, "codec"))
    latents = encoder.latents(colours(rollouts.frames.reshape(-1, *rollouts.frames.shape[2:])))
    return fit_codec(latents, code.directions, code.bits)


def oracle(code: CodeConfig, view: View) -> Messages:
    """The one bit that decides."""
    bit = torch.from_numpy(view.slab)[:, None].float()
    return Messages(torch.nn.functional.pad(bit, (0, CONTENT - 1)), np.ones(len(bit), int))


def raw(code: CodeConfig, view: View) -> Messages:
    """The picture, a float a channel and pixel."""
    pixels = _pixels(view.pictures)
    return Messages(pixels, np.full(len(pixels), WIDEST * pixels.shape[1]))


def compressed(code: CodeConfig, view: View) -> Messages:
    """The picture's JPEG file, opened by the receiver, which reads the pixels."""
    pictures, bits = jpeg(view.pictures, code.quality)
    return Messages(_pixels(pictures), bits)


def compressed_and_encoded(code: CodeConfig, view: View) -> Messages:
    """The picture's JPEG file, which the receiver encodes itself, by the same frozen encoder."""
    pictures, bits = jpeg(view.pictures, code.quality)
    return Messages(torch.from_numpy(view.encoder.latents(pictures)), bits)


def _pixels(pictures: UInt8[np.ndarray, "n h w 3"]) -> Float[Tensor, "n c"]:
    """In the encoder's own input scaling."""
    return torch.from_numpy(pictures.reshape(len(pictures), -1)).float() / 255


KINDS: dict[str, Callable[[CodeConfig, View], Messages]] = {
    "latent": latent,
    "oracle": oracle,
    "raw": raw,
    "jpeg": compressed,
    "jpeg, encoded": compressed_and_encoded,
}
