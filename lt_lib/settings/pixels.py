"""Settings of the rendered-pixel study."""

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from lt_lib.settings.base import Precision, Share, Training
from lt_lib.settings.ppo import PpoConfig


class ExecutorConfig(Training):
    """The low-level controller's pretraining (Section Implementation)."""

    steps: PositiveInt = 1_000_000
    envs: PositiveInt = 64
    rollout: PositiveInt = 128  # control steps an environment and update
    minibatch: PositiveInt = 256
    lr: PositiveFloat = 2.5e-4
    ppo: PpoConfig = PpoConfig()
    precision: Precision = "float32"


class BankConfig(Training):
    """One shard of the episode bank: the frozen executor on every (draw of the scene, slab, route)."""

    entries: PositiveInt = 256  # draws of spawn and scout pose
    envs: PositiveInt = 64
    commit_step: NonNegativeInt = 2
    precision: Precision = "float32"


class HeadConfig(Training):
    """Stage 2: the route head, trained from episode reward alone (Section Implementation)."""

    content: str = "latent"  # a name in comm.messages.CONTENTS
    wire: str = "intact"  # a name in comm.channel.CORRUPTIONS
    held_out: Share = 0.125  # of the bank's draws, kept for evaluation
    episodes: PositiveInt = 6_000
    batch: PositiveInt = 256
    minibatch: PositiveInt = 64
    lr: PositiveFloat = 3e-3
    ppo: PpoConfig = PpoConfig()


class EvaluationConfig(Training):
    """One cell of Table IV: a frozen head under one wire condition."""

    content: str
    wire: str
    held_out: Share = 0.125
    episodes: PositiveInt = 256


class RedrawConfig(Training):
    """The route head trained live, its route drawn anew every so many control steps (lower block of Table III)."""

    content: str = "latent"  # a name in comm.messages.CONTENTS
    every: NonNegativeInt = 0  # control steps between draws, the paper's k; 0: one draw an episode
    credit: str = "episode"  # a name in learners.redraw.CREDITS
    held_out: Share = 0.125  # of the bank's draws, as for the heads that train on the bank
    episodes: PositiveInt = 6_000
    batch: PositiveInt = 256  # episodes
    minibatch: PositiveInt = 64  # episodes' worth of draws
    lr: PositiveFloat = 3e-3
    ppo: PpoConfig = PpoConfig()
    envs: PositiveInt = 64
    commit_step: NonNegativeInt = 2
    precision: Precision = "float32"
