"""The encoder rebuilt at the camera's optics (Section Hardware): the same objective, random floors and walls.

The auxiliary read-out must rebuild the frame's own colours, the random ones; no label enters, here as there.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from sklearn.linear_model import LinearRegression, LogisticRegression
from sklearn.metrics import balanced_accuracy_score

from lt_lib.envs.layout import load_layout
from lt_lib.envs.materials import INDEX
from lt_lib.perception.appearance import SURFACES, draw_appearances, eight_bits, recoloured
from lt_lib.perception.encoder import LATENT
from lt_lib.perception.frames import hazard_visible, random_rollouts, wall_pixels
from lt_lib.perception.gates import PROBE_SHARE, effective_rank
from lt_lib.perception.pictures import PictureEncoder, draw_pictures, fit_pictures
from lt_lib.settings.base import UserError
from lt_lib.settings.hardware import HardwareGates, MatchedEncoderConfig, MatchedGateConfig
from lt_lib.settings.streams import Stream


def train_matched_encoder(config: MatchedEncoderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """`perception.pictures.fit_pictures` on random rollouts in random appearances."""
    rng = Stream.MATCHED_ENCODER.generator(seed)
    return fit_pictures(draw_pictures(config, rng), config, seed, rng, report)


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
