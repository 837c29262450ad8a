"""Stage 1: the pixel encoder trains on random rollouts (Section Encoder and freeze).

The read-out rebuilds the frame coarsely. In each of 16 x 16 cells it names the class of the palette colour at the
cell's centre.
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from lt_lib.envs.camera import network_input
from lt_lib.envs.layout import load_layout
from lt_lib.envs.materials import PALETTE
from lt_lib.perception.encoder import Encoder, in_chunks
from lt_lib.perception.frames import random_rollouts
from lt_lib.perception.objective import Jepa, Losses, class_weights, fit, frozen
from lt_lib.settings.perception import EncoderConfig
from lt_lib.settings.streams import Stream

COLOUR_LEVELS = 4  # quantised levels per colour channel
GRID = 16  # cells per side of the reconstructed frame


def colour_classes() -> Int[np.ndarray, " colours"]:
    """The class of each palette entry: its colour quantised to COLOUR_LEVELS per channel; equal codes share a class."""
    codes = PALETTE.astype(int) * COLOUR_LEVELS // 256 @ np.array([COLOUR_LEVELS**2, COLOUR_LEVELS, 1])
    return np.unique(codes, return_inverse=True)[1]


def train_encoder(config: EncoderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """Trains E and P on random rollouts; returns their weights, the normalisation and the loss curves.

    "E.*", "P.*"   weights
    "mean", "std"  (64,) of the latent over the training frames
    "loss.*"       (updates,) each term before weighting
    """
    rng = Stream.ENCODER.generator(seed)
    rollouts = random_rollouts(load_layout(config.layout), config.frames // config.rollout, config.rollout, rng)
    classes = colour_classes().astype(np.int16)[cells(rollouts.frames)]  # (R, T, 16, 16)
    device = config.device
    with torch.random.fork_rng(devices=[]):  # initialising a module draws from torch's global generator
        torch.manual_seed(seed)
        model = Jepa(Encoder(), class_weights(classes, int(classes.max()) + 1), GRID).to(device)
    frames, actions, codes = rollouts.frames, torch.from_numpy(rollouts.actions), torch.from_numpy(classes)

    def inputs(indices: UInt8[np.ndarray, "b h w"]) -> Float[Tensor, "b h w 3"]:
        return torch.from_numpy(network_input(indices)).to(device)

    def losses(r: Int[np.ndarray, " b"], t: Int[np.ndarray, " b"]) -> Losses:
        goal = model.goal(inputs(frames[r, t + 1]))  # (B, 64)
        latent, rebuilt = model.encoder(inputs(frames[r, t])), codes[r, t].to(device).long()  # (B, 64), (B, 16, 16)
        return model.losses(latent, actions[r, t].to(device), goal, rebuilt)

    curves = fit(model, losses, frames.shape[:2], config, rng, report)
    with torch.no_grad():
        latents = in_chunks(lambda part: model.encoder(inputs(part)), frames.reshape(-1, *frames.shape[2:]))
    return frozen(model, latents) | curves


def cells(frames: UInt8[np.ndarray, "*batch h w"]) -> UInt8[np.ndarray, "*batch g g"]:
    """Frames sampled at the centre of each of GRID x GRID cells."""
    step = frames.shape[-1] // GRID
    return frames[..., step // 2 :: step, step // 2 :: step]
