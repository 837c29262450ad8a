"""Settings of the gridworld."""

from typing import Annotated

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from lt_lib.settings.base import Settings, Share, Training
from lt_lib.settings.perception import EncoderConfig
from lt_lib.settings.ppo import PpoConfig


class PatchEncoderConfig(EncoderConfig):
    """Stage 1 in the gridworld, which has about a hundred views where the pixels have any number."""

    layout: str = "grid"
    variance: NonNegativeFloat = 1.0
    covariance: NonNegativeFloat = 0.1


class PatchGateConfig(Training):
    """How the gridworld's freeze gates are measured: cross-validation over cells, so many folds."""

    layout: str = "grid"
    folds: Annotated[int, Field(ge=2)] = 10


class PatchGates(Settings):
    """The gridworld's pre-registered thresholds."""

    hazard: Share = 0.9
    share: Share = 0.12
    rank: NonNegativeFloat = 20.0


class GridConfig(Training):
    """The gridworld's receiver, trained by MAPPO (Sections Implementation, Gridworld)."""

    layout: str = "grid"
    content: str = "latent"  # a name in comm.grid_wires.GRID_CONTENTS
    steps: PositiveInt = 1_200_000
    envs: PositiveInt = 64
    rollout: PositiveInt = 512  # steps an environment and update
    minibatch: PositiveInt = 1_024
    lr: PositiveFloat = 1e-3
    ppo: PpoConfig = PpoConfig()


class GridEvaluationConfig(Training):
    """A frozen policy of the gridworld under one wire condition."""

    layout: str = "grid"
    content: str
    wire: str  # a name in comm.channel.CORRUPTIONS
    episodes: PositiveInt = 256


class GridworldConfig(Settings):
    """All that the gridworld's protocol needs, in one parameter; every stage takes the section's layout."""

    layout: str = "grid"
    encoder: PatchEncoderConfig = PatchEncoderConfig()
    gates: PatchGates = PatchGates()
    policy: GridConfig = GridConfig()
    seeds: dict[str, PositiveInt]  # how many of each content
