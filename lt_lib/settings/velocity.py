"""Settings of direct transfer to velocity control."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from lt_lib.settings.base import LATENCY, Precision, Settings, Share, Training
from lt_lib.settings.ppo import PpoConfig

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

    decided = (*Training.decided, "content", "latency", "blocked", "starts", "boost")
    content: str = "floor"  # a name in comm.messages.CONTENTS
    latency: NonNegativeInt = LATENCY  # control steps
    blocked: Literal["random", "left", "right"] = "random"  # the slab's corridor; a fixed one leaves no choice
    hazard: NonNegativeFloat = 1.0  # penalty for reaching the slab
    starts: Literal["anywhere", "beyond"] = "beyond"  # the curriculum's: the free arena, or only past the mouths
    spawn_share: Share = 0.5  # of episodes that start at the spawn regardless of the curriculum
    boost: Boost = Boost()
    steps: PositiveInt = 655_360  # 80 updates
    envs: PositiveInt = 128
    rollout: PositiveInt = 64  # control steps per environment and update
    minibatch: PositiveInt = 512
    lr: PositiveFloat = 2.5e-4
    ppo: PpoConfig = PpoConfig()
    precision: Precision = "float32"

    @property
    def condition(self) -> tuple[str, ...]:
        """What one training differs in from another, by which its random stream is named."""
        varied = ("layout", "content", "blocked", "hazard", "starts", "spawn_share", "boost")
        return (*(f"{name} {getattr(self, name)}" for name in varied), f"gamma {self.ppo.gamma}")


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
