"""Sessions with the camera (Section Hardware): labelled frames, from the surrogate camera or from a real one."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lt_lib.envs.layout import load_layout
from lt_lib.hardware import optics
from lt_lib.hardware.placements import Placements, draw_placements, simulated_frames
from lt_lib.hardware.surrogate import SurrogateScene
from lt_lib.perception.appearance import draw_appearances, eight_bits, recoloured
from lt_lib.settings.base import require_known
from lt_lib.settings.hardware import MatchedEncoderConfig, OpticsConfig, SessionConfig, SweepConfig
from lt_lib.settings.streams import Stream


class Effect(NamedTuple):
    """One thing that a camera or a bench does to a picture."""

    unit: str
    strengths: tuple[float, ...]  # rising; or falling, where less is worse


EFFECTS = {
    "distortion": Effect("lens distortion k", (0.0, 0.1, 0.3, 0.6, 1.0)),
    "vignetting": Effect("vignetting: share of light lost in the corner", (0.0, 0.3, 0.6, 0.8, 1.0)),
    "blur": Effect("motion blur (pixels)", (0.0, 1.5, 4.0, 8.0, 16.0)),
    "exposure": Effect("exposure drift, s.d. (stops)", (0.0, 0.25, 0.5, 1.0, 2.0)),
    "balance": Effect("white-balance drift, s.d. (log gain)", (0.0, 0.08, 0.16, 0.32, 0.64)),
    "full_well": Effect("shot noise: electrons at white", (40_000.0, 4_000.0, 400.0, 100.0, 25.0)),
    "read_noise": Effect("read noise (electrons rms of 4,000)", (0.0, 6.0, 60.0, 200.0, 600.0)),
    "mosaic": Effect("Bayer mosaic (0 off, 1 on)", (0.0, 1.0)),
    "jpeg": Effect("JPEG quality", (95.0, 80.0, 40.0, 10.0, 2.0)),
    "dim": Effect("dim lighting (stops darker)", (0.0, 1.0, 2.0, 3.0, 4.0)),
    "clutter": Effect("clutter (objects)", (0.0, 2.0, 4.0, 8.0, 12.0)),
    "position": Effect("placing by hand (± cm)", (0.0, 3.0, 10.0, 20.0, 30.0)),
    "heading": Effect("turning by hand (± degrees)", (0.0, 2.0, 5.0, 8.0, 12.0)),
}


class Session(NamedTuple):
    """N labelled frames, one per decision."""

    frames: UInt8[np.ndarray, "n 64 64 3"]  # RGB, the crop that subtends 32 degrees
    hazard: Bool[np.ndarray, " n"]
    placement: Int[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]  # cm
    dim: Bool[np.ndarray, " n"]


def session_of(result: Mapping[str, np.ndarray]) -> Session:
    """A session as stored in a run's result."""
    return Session(*(result[name] for name in Session._fields))


def film_session(config: SessionConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """The fields of `Session` from the surrogate camera, and "views" (6, 120, 160, 3), whole frames for pictures."""
    rng = Stream.FILM.generator(seed)
    placements = draw_placements(load_layout(config.layout), config, rng)
    taken = _expose(_pictures(config, placements, report), placements, config, rng)
    session = _labelled(np.stack([optics.crop(frame) for frame in taken]), placements, config)
    return session._asdict() | {"views": np.stack(taken[: 6 * config.shots : config.shots])}


def film_sweep(config: SweepConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """One effect at each of its strengths, on the same placements: "frames" (S, N, 64, 64, 3), "hazard" (N,)."""
    strengths, frames, pictures, drawn = EFFECTS[config.effect].strengths, [], [], None
    for i, strength in enumerate(strengths):
        changed = with_effect(config, config.effect, strength)
        rng = Stream.SWEEP.generator(seed)
        placements = draw_placements(load_layout(config.layout), changed, rng)
        if changed.bench != drawn:  # what only the camera changes need not be rendered again
            pictures, drawn = _pictures(changed, placements, report), changed.bench
        frames.append([optics.crop(frame) for frame in _expose(pictures, placements, changed, rng)])
        report((i + 1) / len(strengths))
    return {"frames": np.array(frames), "hazard": _labelled(np.array(frames[0]), placements, config).hazard}


def with_effect(config: SessionConfig, effect: str, strength: float) -> SessionConfig:
    """The session with one field of its camera or its bench changed. Raises UserError for an unknown effect."""
    require_known([effect], EFFECTS, "effect")
    part = "optics" if effect in OpticsConfig.model_fields else "bench"
    ordinary = getattr(config, part)
    value = (
        type(ordinary).model_fields[effect].annotation(strength)
    )  # whole numbers and switches, as the field has them
    return config.model_copy(update={part: ordinary.model_copy(update={effect: value})})


def _pictures(config: SessionConfig, placements: Placements, report) -> list[UInt8[np.ndarray, "h w 3"]]:
    """One rendered picture per placement."""
    width, height = optics.rendered_size()
    scene = SurrogateScene(load_layout(config.layout), width, height, optics.FOCAL * optics.OVERSAMPLING)
    pictures = []
    for i in range(len(placements.side)):
        pictures.append(scene.picture(placements, i, config.bench.clutter))
        report((i + 1) / len(placements.side))
    scene.close()
    return pictures


def _expose(
    pictures, placements: Placements, config: SessionConfig, rng: np.random.Generator
) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Whole frames of the camera, `shots` a picture; the dim state turns all light down."""
    frames = []
    for picture, dim in zip(pictures, placements.dim, strict=True):
        level = 2.0**-config.bench.dim if dim else 1.0
        for _ in range(config.shots):
            shot = optics.draw_shot(config.optics, rng)
            frames.append(optics.expose(picture, config.optics, shot._replace(exposure=level * shot.exposure), rng))
    return frames


def _labelled(frames, placements: Placements, config: SessionConfig) -> Session:
    """Frames with their placements' labels, cut to the number of frames that the session has."""
    placement = np.repeat(np.arange(len(placements.side)), config.shots)
    keep = slice(config.frames or None)
    labels = (placements.hazard, np.arange(len(placements.side)), 100 * placements.distance, placements.dim)
    return Session(frames[keep], *(each[placement][keep] for each in labels))


def simulated_session(config: SessionConfig, looks: MatchedEncoderConfig, seed: int) -> Session:
    """The bench as the simulation shows it, one frame per placement, floor and walls as in an encoder's training."""
    rng = Stream.SIMULATED_BENCH.generator(seed)
    layout = load_layout(config.layout)
    placements = draw_placements(layout, config, rng)
    frames = simulated_frames(layout, placements)
    appearances = draw_appearances(len(frames), layout.camera.pixels, looks.colour, looks.texture, rng)
    pictures = eight_bits(recoloured(frames, appearances))
    return _labelled(pictures, placements, config.model_copy(update={"shots": 1, "frames": 0}))
