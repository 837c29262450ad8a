"""The encoder rebuilt at the camera's optics (Section Hardware): the same objective, random floors and walls.

The auxiliary read-out must rebuild the frame's own colours, the random ones; no label enters, here as there.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from sklearn.linear_model import LinearRegression, LogisticRegression
from sklearn.metrics import balanced_accuracy_score
from torch import Tensor

from lt_lib.envs.layout import load_layout
from lt_lib.envs.materials import INDEX
from lt_lib.hardware.randomise import SURFACES, Appearances, draw_appearances, eight_bits, recoloured
from lt_lib.perception.encoder import LATENT, Encoder, Frozen, in_chunks
from lt_lib.perception.frames import Rollouts, hazard_visible, random_rollouts, wall_pixels
from lt_lib.perception.gates import PROBE_SHARE, effective_rank
from lt_lib.perception.jepa import COLOUR_LEVELS, GRID
from lt_lib.perception.objective import Jepa, Losses, class_weights, fit, frozen
from lt_lib.settings.base import UserError
from lt_lib.settings.hardware import HardwareGates, MatchedEncoderConfig, MatchedGateConfig
from lt_lib.settings.streams import Stream

SAMPLE = 2_048  # frames that the class weights and the normalisation are taken from


class PictureEncoder(Frozen):
    """For RGB pictures (B, 64, 64, 3), from the flat mapping that `train_matched_encoder` returns."""

    def __init__(self, weights: Mapping[str, np.ndarray], device: str = "cpu"):
        super().__init__(Encoder(), weights, device, "float32")

    def inputs(self, observations: UInt8[np.ndarray, "b 64 64 3"]) -> Float[Tensor, "b 64 64 3"]:
        return torch.from_numpy(observations.astype(np.float32) / 255).to(self.device)

    def latents(self, pictures: UInt8[np.ndarray, "n 64 64 3"]) -> Float[np.ndarray, "n 64"]:
        """Normalised latents of any number of pictures."""
        return in_chunks(self.latent, pictures)


def colour_codes(colours: Float[np.ndarray, "b h w 3"]) -> Int[np.ndarray, "b g g"]:
    """The class of each cell: the colour at its centre, quantised to COLOUR_LEVELS a channel."""
    step = colours.shape[1] // GRID
    cells = colours[:, step // 2 :: step, step // 2 :: step]
    quantised = np.minimum((cells * COLOUR_LEVELS).astype(np.int64), COLOUR_LEVELS - 1)
    return quantised @ np.array([COLOUR_LEVELS**2, COLOUR_LEVELS, 1])


def train_matched_encoder(config: MatchedEncoderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """Trains E and P on random rollouts in random appearances; returns what `jepa.train_encoder` does.

    "E.*", "P.*"  weights;  "mean", "std" (64,) of the latent over training frames
    "loss.*"      (updates,) each term before weighting
    """
    rng = Stream.MATCHED_ENCODER.generator(seed)
    layout = load_layout(config.layout)
    rollouts = random_rollouts(layout, config.frames // config.rollout, config.rollout, rng)
    looks = draw_appearances(len(rollouts.frames), layout.camera.pixels, config.colour, config.texture, rng)
    sample = _sample(rollouts, looks, rng)
    device = config.device
    with torch.random.fork_rng(devices=[]):  # module initialisation draws from torch's global generator
        torch.manual_seed(seed)
        model = Jepa(Encoder(), class_weights(colour_codes(sample), COLOUR_LEVELS**3), GRID).to(device)
    frames, actions = rollouts.frames, torch.from_numpy(rollouts.actions)

    def losses(r: Int[np.ndarray, " b"], t: Int[np.ndarray, " b"]) -> Losses:
        now, following = (recoloured(frames[r, t + k], looks.of(r)) for k in (0, 1))
        codes = torch.from_numpy(colour_codes(now)).to(device)
        goal = model.goal(torch.from_numpy(following).to(device))
        latent = model.encoder(torch.from_numpy(now).to(device))
        return model.losses(latent, actions[r, t].to(device), goal, codes)

    curves = fit(model, losses, frames.shape[:2], config, rng, report)
    with torch.no_grad():
        latents = model.encoder(torch.from_numpy(sample).to(device)).cpu().numpy()
    return frozen(model, latents) | curves


def _sample(rollouts: Rollouts, looks: Appearances, rng: np.random.Generator) -> Float[np.ndarray, "n h w 3"]:
    r, t = (rng.integers(0, n, SAMPLE) for n in rollouts.frames.shape[:2])
    return recoloured(rollouts.frames[r, t], looks.of(r))


class Shown(NamedTuple):
    """What a candidate showed at the gates, on held-out rollouts in appearances that no candidate was trained on."""

    hazard: float  # balanced accuracy of the linear hazard-visible probe
    walls: float  # R^2 of the linear wall-count probe
    rank: float  # effective rank, by singular values
    appearance: float  # R^2 of a linear probe of the colours of floor, walls and barrier


def measure_matched_gates(
    config: MatchedGateConfig, seed: int, *, report: Callable[[float], None], encoder: Mapping[str, np.ndarray]
) -> dict:
    """The fields of `Shown` for one checkpoint, probes fitted on 70% of the rollouts and scored on the others."""
    rng = Stream.MATCHED_GATES.generator(seed)
    layout = load_layout(config.layout)
    rollouts = random_rollouts(layout, config.rollouts, config.length, rng)
    looks = draw_appearances(config.rollouts, layout.camera.pixels, config.colour, config.texture, rng)
    network = PictureEncoder(encoder, config.device)
    latents = np.empty((config.rollouts, config.length, LATENT))
    for t in range(config.length):
        latents[:, t] = network.latents(eight_bits(recoloured(rollouts.frames[:, t], looks)))
        report((t + 1) / config.length)
    visible, walls = hazard_visible(rollouts.frames), wall_pixels(rollouts.frames)
    own = looks.palettes[:, [INDEX[names[0]] for names in SURFACES]].reshape(len(latents), 1, -1)
    colours = np.repeat(own, config.length, axis=1)  # (rollouts, length, 9)
    cut = int(len(latents) * PROBE_SHARE)
    train, test = latents[:cut].reshape(-1, LATENT), latents[cut:].reshape(-1, LATENT)
    probe = LogisticRegression(class_weight="balanced", max_iter=2000).fit(train, visible[:cut].ravel())
    wall_probe = LinearRegression().fit(train, walls[:cut].ravel())
    colour_probe = LinearRegression().fit(train, colours[:cut].reshape(len(train), -1))
    return Shown(
        float(balanced_accuracy_score(visible[cut:].ravel(), probe.predict(test))),
        float(wall_probe.score(test, walls[cut:].ravel())),
        effective_rank(latents.reshape(-1, LATENT)),
        float(colour_probe.score(test, colours[cut:].reshape(len(test), -1))),
    )._asdict()


def select(shown: Mapping[str, Mapping[str, float]], gates: HardwareGates) -> str:
    """The candidate with the best hazard probe among those that pass every gate.

    Raises UserError, one line, if none passes.
    """
    limits = {"hazard": gates.hazard, "walls": gates.walls, "rank": gates.rank}
    passed = [name for name, each in shown.items() if all(each[key] >= limit for key, limit in limits.items())]
    if not passed:
        best = max(shown, key=lambda name: shown[name]["hazard"])
        values = ", ".join(f"{key} {shown[best][key]:.3f} of {limit:g}" for key, limit in limits.items())
        raise UserError(f"no encoder candidate passed the gates; the best, '{best}', reached {values}")
    return max(passed, key=lambda name: shown[name]["hazard"])
