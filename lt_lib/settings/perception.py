"""Settings of stage 1: the pixel encoder and its freeze gates."""

from typing import Annotated

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from lt_lib.settings.base import Scene, Settings, Share, Training


class ObjectiveConfig(Scene):
    """Stage 1 for any encoder (Section Implementation); loss weights are ours, see ASSUMPTIONS.md."""

    frames: PositiveInt = 204_800
    rollout: Annotated[int, Field(ge=2)] = 32  # frames per rollout
    epochs: NonNegativeFloat = 2.5
    batch: Annotated[int, Field(ge=2)] = 256
    lr: PositiveFloat = 1e-3
    ema: Annotated[float, Field(ge=0, lt=1)] = 0.99
    prediction: NonNegativeFloat = 1.0
    variance: NonNegativeFloat = 25.0
    covariance: NonNegativeFloat = 1.0
    reconstruction: NonNegativeFloat = 1.0


class EncoderConfig(ObjectiveConfig, Training):
    """Stage 1 for the pixel encoder."""


class PictureConfig(EncoderConfig):
    """Stage 1 on pictures whose floor and walls are recoloured in every rollout (Section Hardware)."""

    decided = (*EncoderConfig.decided, "colour", "texture")
    colour: Share = 0.0  # of a material's colour that a random one replaces; 0 keeps the simulation's
    texture: NonNegativeFloat = 0.0  # standard deviation of the blotches on floor and walls, as a share of their colour


class GateConfig(Training):
    """How the freeze gates are measured: held-out rollouts, and the number of latents to show."""

    rollouts: Annotated[int, Field(ge=10)] = 640
    length: PositiveInt = 32
    shown: PositiveInt = 4_000


class Gates(Settings):
    """The pre-registered thresholds; the defaults are the paper's measured hazard probe and ours for the rest."""

    hazard: Share = 0.935
    walls: Annotated[float, Field(le=1)] = 0.95
    rank: NonNegativeFloat = 40.0
