"""Settings of direct transfer to velocity control."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from lt_lib.settings.base import LATENCY, Settings, Share, Training, require_looks
from lt_lib.settings.devices import Precision
from lt_lib.settings.ppo import PpoConfig

# Where a navigator that is never told anything learned to drive (velocity/transfer.py)
Curriculum = Literal["one corridor, past the mouths", "either corridor, past the mouths", "either corridor, anywhere"]
# The six direct transfers to velocity control, by what each varies (velocity/transfer.py)
Configuration = Literal[
    "base", "no hazard penalty", "hazard penalty x 5", "discount 0.995", "more spawn curriculum", "wide layout",
]  # fmt: skip


class Boost(Settings):
    """Extra lateral noise in an episode's first steps (Section Effect of increased exploration noise); 1 is none."""

    first: Annotated[float, Field(ge=1)] = 1.0  # times the policy's own noise, before the first iteration
    last: Annotated[float, Field(ge=1)] = 1.0  # at iteration `at`
    at: PositiveInt = 80
    window: NonNegativeInt = 40  # control steps
    tau: NonNegativeFloat = 30.0  # control steps, AR(1)


class NavigatorConfig(Training):
    """A navigator without a route: PPO from the team's reward (Section From Grid Actions to Velocity Commands)."""

    decided = (
        *Training.decided, "content", "latency", "blocked", "starts", "boost", "looks", "slab_ends", "step_cost",
    )  # fmt: skip
    content: str = "floor"  # a name in comm.messages.CONTENTS
    latency: NonNegativeInt = LATENCY  # control steps
    blocked: Literal["random", "left", "right"] = "random"  # the slab's corridor; a fixed one leaves no choice
    hazard: NonNegativeFloat = 1.0  # penalty for every control step in contact with the slab
    slab_ends: bool = True  # whether reaching the slab ends a training episode
    step_cost: NonNegativeFloat = 0.0  # penalty for every control step
    starts: Literal["anywhere", "beyond"] = "beyond"  # the curriculum's: the free arena, or only past the mouths
    spawn_share: Share = 0.5  # of episodes that start at the spawn regardless of the curriculum
    boost: Boost = Boost()
    steps: PositiveInt = 229_376  # 28 updates
    looks: tuple[PositiveInt, ...] = ()  # control steps after which the weights are kept too, whole updates each
    envs: PositiveInt = 128
    rollout: PositiveInt = 64  # control steps per environment and update
    minibatch: PositiveInt = 512
    lr: PositiveFloat = 2.5e-4
    ppo: PpoConfig = PpoConfig()
    precision: Precision = "float32"

    @model_validator(mode="after")
    def _looks_between_updates(self) -> "NavigatorConfig":
        require_looks(self.looks, self.envs * self.rollout, self.steps)
        return self

    @property
    def condition(self) -> tuple[str, ...]:
        """What one training differs in from another, by which its random stream is named."""
        varied = (
            "layout", "content", "blocked", "hazard", "slab_ends", "step_cost", "starts", "spawn_share", "boost",
        )  # fmt: skip
        return (*(f"{name} {getattr(self, name)}" for name in varied), f"gamma {self.ppo.gamma}")


class PretrainingConfig(Settings):
    """The navigators of Table II, which the paper says were pretrained and no more.

    `NavigatorConfig.steps` is the length of all trainings in the study; it is one of `looks`.
    """

    curriculum: Curriculum = "either corridor, anywhere"
    looks: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = (
        98_304, 131_072, 163_840, 196_608, 229_376, 262_144, 294_912, 327_680,
    )  # fmt: skip
    seeds: PositiveInt = 3
    episodes: PositiveInt = 32  # per row and seed at each look, and wherever a picture needs no more
    boosted: PositiveInt = 80  # iterations of further training with the boost
    bit_looks: tuple[PositiveInt, ...] = (131_072, 262_144, 393_216)  # of navigators that are told the bit

    @model_validator(mode="after")
    def _in_order(self) -> "PretrainingConfig":
        for name in ("looks", "bit_looks"):
            if list(getattr(self, name)) != sorted(set(getattr(self, name))):
                raise ValueError(f"{name} must increase, got {list(getattr(self, name))}")
        return self


class Exploration(Settings):
    """One row of Table II: lateral AR(1) noise imposed on the first `window` steps of an episode."""

    sigma: NonNegativeFloat = 0.0  # stationary standard deviation, of a command in [-1, 1]
    tau: NonNegativeFloat = 0.0  # correlation time, control steps; 0 is iid
    window: NonNegativeInt = 600  # control steps; after it the lateral noise is the policy's own
    own: NonNegativeFloat = 1.0  # factor on the policy's own noise, elsewhere; 0 is deterministic


class RolloutConfig(Training):
    """Episodes of a frozen navigator, no learning."""

    decided = (
        *Training.decided, "content", "latency", "start", "blocked", "truthful", "rows", "precision",
    )  # fmt: skip
    content: str = "floor"
    latency: NonNegativeInt = LATENCY  # control steps
    start: Literal["spawn", "left", "right"] = "spawn"  # or in front of a corridor's mouth
    blocked: Literal["random", "left", "right"] = "random"
    truthful: bool = True  # whether an oracle's message is true or flipped
    rows: Annotated[tuple[Exploration, ...], Field(min_length=1)] = (Exploration(),)
    episodes: PositiveInt = 128  # per row
    paths: NonNegativeInt = 24  # episodes per row whose path is kept
    horizon: PositiveInt = 600  # control steps
    precision: Precision = "float32"
