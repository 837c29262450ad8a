"""Settings of the hardware decode."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from lt_lib.settings.base import Scene, Settings, Share, Training
from lt_lib.settings.perception import PictureConfig


class MatchedEncoderConfig(PictureConfig):
    """Stage 1 with the camera's optics; floor and walls are recoloured in every rollout (Section Hardware)."""

    layout: str = "matched"
    frames: PositiveInt = 102_400
    covariance: NonNegativeFloat = 2.5  # with which its gates were fixed
    colour: Share = 1.0


class MatchedGateConfig(Training):
    """How a candidate's gates are measured: held-out rollouts, one appearance range for all candidates."""

    layout: str = "matched"
    rollouts: Annotated[int, Field(ge=10)] = 480
    length: PositiveInt = 32
    colour: Share = 1.0
    texture: NonNegativeFloat = 0.1


class OpticsConfig(Settings):
    """The surrogate camera from lens to file; every field is an effect, its strength and its unit."""

    distortion: NonNegativeFloat = 0.1  # k: image radius r (focal lengths) shows what lies at r (1 + k r^2); barrel
    vignetting: Share = 0.3  # share of the light lost in the frame's corner
    blur: NonNegativeFloat = 1.5  # pixels of image motion during an exposure, in a random direction
    exposure: NonNegativeFloat = 0.25  # stops, standard deviation of the drift from frame to frame
    balance: NonNegativeFloat = 0.08  # standard deviation of the log gain of red and of blue
    full_well: PositiveFloat = 4_000.0  # electrons at white: shot noise
    read_noise: NonNegativeFloat = 6.0  # electrons rms
    mosaic: bool = True  # one colour per pixel, the others interpolated (Bayer)
    jpeg: Annotated[int, Field(ge=1, le=100)] = 80  # quality


class BenchConfig(Settings):
    """How the robot stands in front of a corridor, and what else is there."""

    turn: Annotated[float, Field(gt=0, lt=90)] = 18.0  # degrees off the centre line, towards the corridor in question
    position: NonNegativeFloat = 3.0  # cm, +- error of placing the robot by hand
    heading: NonNegativeFloat = 2.0  # degrees, +- error of its heading by hand
    clutter: Annotated[int, Field(ge=0, le=12)] = 4  # objects on the floor
    dim: NonNegativeFloat = 1.0  # stops by which the dim state's light is lowered, besides a lamp that is off


class SessionConfig(Scene):
    """One session: a number of placements, a few frames per placement."""

    layout: str = "matched"
    hazard: PositiveInt = 19  # placements with the slab in the corridor in question
    clear: PositiveInt = 15  # placements with the slab in the other one
    shots: PositiveInt = 3  # frames per placement
    frames: NonNegativeInt = 0  # the session ends after this many; 0: after the last placement
    near: PositiveFloat = 120.0  # cm from the camera to the slab's front
    far: PositiveFloat = 250.0  # cm
    marks: NonNegativeInt = 0  # distances, evenly spaced from near to far; 0: anywhere between
    lighting: tuple[Literal["bright", "dim"], ...] = ("bright", "dim")  # taken in turn
    bench: BenchConfig = BenchConfig()
    optics: OpticsConfig = OpticsConfig()

    @model_validator(mode="after")
    def _near_is_nearer(self) -> "SessionConfig":
        if not self.near < self.far:
            raise ValueError(f"near must be below far, got {self.near} and {self.far} cm")
        return self


class SessionsConfig(Settings):
    """The sessions with the camera (Section Hardware): refit, quarantined validation, live."""

    refit: SessionConfig = SessionConfig(hazard=9, clear=9, frames=53, far=240.0, marks=5, lighting=("bright",))
    validation: SessionConfig = SessionConfig(hazard=7, clear=7, near=135.0, far=225.0, marks=4, lighting=("dim",))
    live: SessionConfig = SessionConfig()


class SweepConfig(SessionConfig):
    """One effect at increasing strengths, otherwise as in `SessionConfig`; all strengths share the placements."""

    effect: str  # a name in hardware.sessions.EFFECTS
    hazard: PositiveInt = 10
    clear: PositiveInt = 10
    shots: PositiveInt = 2


class RailsConfig(Training):
    """How bang-bang an executor is, on frames of held-out rollouts, under both routes."""

    layout: str = "matched"
    rollouts: PositiveInt = 64
    length: PositiveInt = 32
    draws: PositiveInt = 32  # of the scene, each under both placements and both routes, for its obedience


class HardwareGates(Settings):
    """params/gates/hardware.yaml, explained at its top; fixed before any camera frame was seen."""

    candidates: Annotated[dict[str, dict[Literal["colour", "texture"], Share]], Field(min_length=1)]
    hazard: Share
    walls: Annotated[float, Field(le=1)]  # R^2
    rank: NonNegativeFloat
    decode: Share
    red_ratio: PositiveFloat
    red_share: Share
