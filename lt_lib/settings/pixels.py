"""Settings of the rendered-pixel study."""

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from lt_lib.settings.base import LATENCY, Settings, Share, Training, require_looks
from lt_lib.settings.devices import Precision
from lt_lib.settings.perception import EncoderConfig, GateConfig, Gates
from lt_lib.settings.ppo import PpoConfig


class ExecutorConfig(Training):
    """The low-level controller's pretraining (Section Implementation)."""

    decided = (*Training.decided, "looks")
    steps: PositiveInt = 1_000_000
    looks: tuple[PositiveInt, ...] = ()  # control steps after which the weights are kept too, whole updates each
    envs: PositiveInt = 64
    rollout: PositiveInt = 128  # control steps per environment and update
    minibatch: PositiveInt = 256
    lr: PositiveFloat = 2.5e-4
    ppo: PpoConfig = PpoConfig()
    precision: Precision = "float32"

    @model_validator(mode="after")
    def _looks_between_updates(self) -> "ExecutorConfig":
        require_looks(self.looks, self.envs * self.rollout, self.steps)
        return self


class BankConfig(Training):
    """One shard of the episode bank: the frozen executor on every (draw of the scene, slab, route).

    The bank defines the draws held out for evaluation and the step at which a route is commanded; whatever trains or
    evaluates on its scenes reads both from it.
    """

    entries: PositiveInt = 256  # draws of spawn and scout pose
    envs: PositiveInt = 256  # episodes side by side
    commit_step: NonNegativeInt = 2  # control steps that the navigator waits
    held_out: Share = 0.125  # of the draws, kept for evaluation
    precision: Precision = "float32"


class HeadConfig(Training):
    """Stage 2: the route head, trained from episode reward alone (Section Implementation)."""

    decided = (*Training.decided, "content", "wire", "latency")
    content: str = "latent"  # a name in comm.messages.CONTENTS
    wire: str = "intact"  # a name in comm.channel.WIRES
    latency: NonNegativeInt = LATENCY  # control steps
    episodes: PositiveInt = 6_000
    batch: PositiveInt = 256
    minibatch: PositiveInt = 64  # episodes
    lr: PositiveFloat = 3e-3
    ppo: PpoConfig = PpoConfig()


class EvaluationConfig(Training):
    """One cell of Table IV: a frozen head under one wire condition."""

    decided = (*Training.decided, "content", "wire", "latency")
    content: str
    wire: str
    latency: NonNegativeInt = LATENCY  # control steps
    episodes: PositiveInt = 256


class RedrawConfig(Training):
    """The route head trained live, its route redrawn every `every` control steps (lower block of Table III)."""

    decided = (*Training.decided, "content", "every", "credit", "latency", "minibatch", "lr")
    content: str = "latent"  # a name in comm.messages.CONTENTS
    latency: NonNegativeInt = LATENCY  # control steps
    every: NonNegativeInt = 0  # control steps between draws, the paper's k; 0: one draw per episode
    credit: str = "episode"  # a name in pixels.redraw.CREDITS
    episodes: PositiveInt = 6_000
    batch: PositiveInt = 256  # episodes
    minibatch: PositiveInt = 64  # episodes' worth of draws; this and the rate are those of `HeadConfig`
    lr: PositiveFloat = 3e-3
    ppo: PpoConfig = PpoConfig()
    envs: PositiveInt = 256  # episodes side by side
    precision: Precision = "float32"


class PixelsConfig(Settings):
    """All settings of the pixel protocol in one parameter; layout and device are separate parameters."""

    latency: NonNegativeInt = LATENCY  # control steps, of every channel
    encoder: EncoderConfig = EncoderConfig()
    probe: GateConfig = GateConfig()
    gates: Gates = Gates()
    executor: ExecutorConfig = ExecutorConfig()
    bank: BankConfig = BankConfig()
    shards: PositiveInt = 8  # runs that the bank is split into, each of `bank.entries` draws
    head: HeadConfig = HeadConfig()
    redraw: RedrawConfig = RedrawConfig()

    @model_validator(mode="after")
    def _draws_for_training_and_for_evaluation(self) -> "PixelsConfig":
        draws, held_out = self.shards * self.bank.entries, self.bank.held_out
        if not 1 <= int(draws * held_out) < draws:
            raise ValueError(
                f"a bank of {self.shards} x {self.bank.entries} draws with a share of {held_out} held out leaves none "
                "to train on or none to evaluate on; give it more entries, or another held_out"
            )
        return self
