"""Settings of the gridworld."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from lt_lib.settings.base import LATENCY, Scene, Settings, Share
from lt_lib.settings.perception import ObjectiveConfig
from lt_lib.settings.ppo import PpoConfig

# How a frozen latent enters the policy: every dimension standardised, all by one standard deviation, or as it comes
Scaled = Literal["each", "one", "none"]


class PatchEncoderConfig(ObjectiveConfig):
    """Stage 1 in the gridworld, which has about a hundred views; the pixel scene has unlimited ones."""

    layout: str = "grid"
    variance: NonNegativeFloat = 1.0
    covariance: NonNegativeFloat = 0.1


class PatchGateConfig(Scene):
    """How the gridworld's freeze gates are measured: cross-validation over cells."""

    layout: str = "grid"
    folds: Annotated[int, Field(ge=2)] = 10


class PatchGates(Settings):
    """The gridworld's pre-registered thresholds."""

    hazard: Share = 0.9
    share: Share = 0.12
    rank: NonNegativeFloat = 20.0


class GridConfig(Scene):
    """The gridworld's receiver, trained by MAPPO (Sections Implementation, Gridworld)."""

    decided = (*Scene.decided, "content", "latency", "value_gain", "view")
    layout: str = "grid"
    content: str = "latent"  # a name in gridworld.wires.GRID_CONTENTS
    view: Literal["cells", "pixels"] = "cells"  # a name in gridworld.views.VIEWS
    value_gain: NonNegativeFloat = 0.0  # of the value projection's orthogonal start; 0 starts it at zero
    latency: NonNegativeInt = LATENCY  # steps
    steps: PositiveInt = 1_200_000
    envs: PositiveInt = 64
    rollout: PositiveInt = 375  # steps per environment and update, so that the paper's steps are whole updates
    minibatch: PositiveInt = 1_024
    lr: PositiveFloat = 1e-3
    ppo: PpoConfig = PpoConfig()


class GridEvaluationConfig(Scene):
    """A frozen policy of the gridworld under one wire condition."""

    layout: str = "grid"
    content: str
    latency: NonNegativeInt = LATENCY  # steps
    wire: str  # a name in comm.channel.CORRUPTIONS
    episodes: PositiveInt = 256


class GridworldConfig(Settings):
    """All settings of the gridworld's protocol in one parameter; every stage uses its layout."""

    layout: str = "grid"
    latency: NonNegativeInt = LATENCY  # steps
    encoder: PatchEncoderConfig = PatchEncoderConfig()
    gates: PatchGates = PatchGates()
    policy: GridConfig = GridConfig()
    scaled: Scaled = "each"
    seeds: dict[str, PositiveInt]  # number per content
