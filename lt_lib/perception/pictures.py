"""The pixel encoder on RGB pictures, in which floor and walls may have any colour (Section Hardware).

The fast camera's palette indices become pictures one rollout at a time, each in an appearance of its own. The auxiliary
read-out then rebuilds the picture's own colours, the random ones; no label enters, here as in `jepa`.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from lt_lib.envs.camera import network_input
from lt_lib.envs.layout import load_layout
from lt_lib.perception.appearance import Appearances, draw_appearances, recoloured
from lt_lib.perception.encoder import LATENT, Encoder, Frozen, in_chunks
from lt_lib.perception.frames import Rollouts, random_rollouts
from lt_lib.perception.jepa import COLOUR_LEVELS, GRID
from lt_lib.perception.objective import Jepa, Losses, class_weights, fit, frozen
from lt_lib.settings.perception import PictureConfig

SAMPLE = 2_048  # pictures that the class weights and the normalisation are taken from
PIXELS = 64


class Projection(nn.Module):
    """A linear map of pictures (B, 64, 64, 3) in [0, 1] to raw latents (B, 64)."""

    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(PIXELS * PIXELS * 3, LATENT)

    def forward(self, pictures: Float[Tensor, "b 64 64 3"]) -> Float[Tensor, "b 64"]:
        return self.linear(pictures.flatten(1))


class PictureEncoder(Frozen):
    """The frozen form for RGB pictures (B, 64, 64, 3): of the encoder, or of a projection, as the weights say."""

    def __init__(self, weights: Mapping[str, np.ndarray], device: str = "cpu"):
        network = Projection() if "E.linear.weight" in weights else Encoder()
        super().__init__(network, weights, device, "float32")

    def inputs(self, observations: UInt8[np.ndarray, "b 64 64 3"]) -> Float[Tensor, "b 64 64 3"]:
        return torch.from_numpy(observations.astype(np.float32) / 255).to(self.device)

    def latents(self, pictures: UInt8[np.ndarray, "n 64 64 3"]) -> Float[np.ndarray, "n 64"]:
        """Normalised latents of any number of pictures."""
        return in_chunks(self.latent, pictures)


class Pictures(NamedTuple):
    """R rollouts of T frames, each rollout in an appearance of its own, or all in the simulation's."""

    rollouts: Rollouts
    looks: Appearances | None

    @property
    def shape(self) -> tuple[int, int]:
        """R and T."""
        return self.rollouts.frames.shape[:2]

    def colours(self, r: Int[np.ndarray, " b"], t: Int[np.ndarray, " b"]) -> Float[np.ndarray, "b h w 3"]:
        """Colours in [0, 1] of frames t of rollouts r."""
        frames = self.rollouts.frames[r, t]
        return network_input(frames) if self.looks is None else recoloured(frames, self.looks.of(r))

    def sample(self, rng: np.random.Generator) -> Float[np.ndarray, "n h w 3"]:
        """SAMPLE frames of all."""
        return self.colours(*(rng.integers(0, n, SAMPLE) for n in self.shape))


def draw_pictures(config: PictureConfig, rng: np.random.Generator) -> Pictures:
    """Random rollouts, and how each looks."""
    layout = load_layout(config.layout)
    rollouts = random_rollouts(layout, config.frames // config.rollout, config.rollout, rng)
    if not config.colour and not config.texture:
        return Pictures(rollouts, None)
    n, pixels = len(rollouts.frames), layout.camera.pixels
    return Pictures(rollouts, draw_appearances(n, pixels, config.colour, config.texture, rng))


def colour_codes(colours: Float[np.ndarray, "b h w 3"]) -> Int[np.ndarray, "b g g"]:
    """The class of each cell: the colour at its centre, quantised to COLOUR_LEVELS a channel."""
    step = colours.shape[1] // GRID
    cells = colours[:, step // 2 :: step, step // 2 :: step]
    quantised = np.minimum((cells * COLOUR_LEVELS).astype(np.int64), COLOUR_LEVELS - 1)
    return quantised @ np.array([COLOUR_LEVELS**2, COLOUR_LEVELS, 1])


def fit_pictures(
    pictures: Pictures, config: PictureConfig, seed: int, rng: np.random.Generator, report: Callable[[float], None]
) -> dict:
    """Trains E and P on pictures; returns what `jepa.train_encoder` does.

    "E.*", "P.*"  weights;  "mean", "std" (64,) of the latent over training pictures
    "loss.*"      (updates,) each term before weighting
    """
    sample, device = pictures.sample(rng), config.device
    with torch.random.fork_rng(devices=[]):  # module initialisation draws from torch's global generator
        torch.manual_seed(seed)
        model = Jepa(Encoder(), class_weights(colour_codes(sample), COLOUR_LEVELS**3), GRID).to(device)
    actions = torch.from_numpy(pictures.rollouts.actions)

    def losses(r: Int[np.ndarray, " b"], t: Int[np.ndarray, " b"]) -> Losses:
        now, following = pictures.colours(r, t), pictures.colours(r, t + 1)
        codes = torch.from_numpy(colour_codes(now)).to(device)
        goal = model.goal(torch.from_numpy(following).to(device))
        latent = model.encoder(torch.from_numpy(now).to(device))
        return model.losses(latent, actions[r, t].to(device), goal, codes)

    curves = fit(model, losses, pictures.shape, config, rng, report)
    with torch.no_grad():
        latents = model.encoder(torch.from_numpy(sample).to(device)).cpu().numpy()
    return frozen(model, latents) | curves
