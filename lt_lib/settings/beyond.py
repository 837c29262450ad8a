"""Settings of the experiments beyond the paper."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from lt_lib.settings.base import LATENCY, Settings, Share, Training
from lt_lib.settings.gridworld import GridConfig, PatchEncoderConfig
from lt_lib.settings.hardware import OpticsConfig
from lt_lib.settings.perception import PictureConfig
from lt_lib.settings.pixels import HeadConfig
from lt_lib.settings.ppo import PpoConfig


class SenderConfig(PictureConfig):
    """Training of one sender: the paper's frames, batch, rate and number of updates for every kind that is trained."""

    decided = (*PictureConfig.decided, "kind")
    kind: str = "jepa"  # a name in beyond.senders.SENDERS
    every: PositiveInt = 10  # the principal components take each such frame of a rollout
    apart: PositiveInt = 4  # most frames between the two views of a contrastive pair
    temperature: PositiveFloat = 0.1  # of the contrastive loss


class SenderGateConfig(PictureConfig):
    """How a sender's probes and rank are measured: held-out rollouts in the appearances of its own training."""

    rollouts: Annotated[int, Field(ge=10)] = 160
    length: PositiveInt = 32


class Rung(Settings):
    """How one scene of the ladder differs from the paper's, for every sender alike; the defaults are the paper's."""

    appearance: Share = 0.0  # of floor's and walls' colour that a random one replaces, drawn per frame
    exposure: NonNegativeFloat = 0.0  # stops, standard deviation of a frame's brightness
    noise: Share = 0.0  # of pixels that show a random material
    redness: Share | None = None  # of an upright object beside the scout's view of the slab, from yellow to its red
    back: NonNegativeFloat = 0.0  # metres that the scout stands farther from the slab
    jitter: Annotated[float, Field(ge=1)] = 1.0  # times the jitter of the scout's post, place and heading
    anywhere: bool = False  # the scout stands anywhere beyond the barrier from where it sees the slab
    least: PositiveInt = 40  # pixels of the slab in one placement or the other that count as seeing it

    @model_validator(mode="after")
    def _one_post(self) -> "Rung":
        if self.anywhere and (self.back or self.jitter > 1):
            raise ValueError("a scout that stands anywhere has no post to move back from or to jitter about")
        return self


class ReaderConfig(HeadConfig):
    """Heads that learn to read one sender on one rung (Section Route head, with other senders)."""

    decided = (*HeadConfig.decided, "sender", "rung")
    sender: str  # what the heads read; names their random stream
    rung: Rung = Rung()
    repeats: PositiveInt = 2  # scenes per draw of the bank
    heads: PositiveInt = 5  # seeds
    share: Annotated[float, Field(gt=0, le=1)] = 0.1  # of the episodes that a second set of heads gets


class EndToEndConfig(ReaderConfig):
    """A sender that learns with its head, by the receiver's policy gradient."""

    sender_lr: PositiveFloat = 1e-3  # of the sender's network, as in stage 1; the head keeps its own rate


class DeciderSizes(Settings):
    """How heads of other decisions are trained (Section Route head)."""

    scenes: Annotated[int, Field(ge=16)] = 8_192
    held_out: Annotated[float, Field(gt=0, lt=1)] = 0.125  # of the scenes, kept for evaluation
    episodes: PositiveInt = 6_000
    batch: PositiveInt = 256
    minibatch: PositiveInt = 128  # episodes
    lr: PositiveFloat = 3e-3
    ppo: PpoConfig = PpoConfig()
    heads: PositiveInt = 5  # seeds


class DeciderConfig(DeciderSizes, Training):
    """Heads that learn one task from one message."""

    decided = (*Training.decided, "task", "message")
    task: str  # a name in beyond.tasks.TASKS
    message: str  # a name in beyond.deciders.MESSAGES


class MovingSizes(DeciderSizes):
    """Scouts that drive, and heads that read their messages."""

    scenes: Annotated[int, Field(ge=16)] = 4_096
    every: PositiveInt = 4  # control steps between messages
    commit_step: PositiveInt = 40  # control steps that the navigator waits
    errands: Share = 0.0  # probability that a scout drives to the goal through the free corridor; else it patrols
    watching: Share = 1.0  # probability that a patrol faces the barrier on its way to a place
    scouts: PositiveInt = 1


class MovingConfig(MovingSizes, Training):
    """One content from scouts that drive."""

    decided = (*Training.decided, "content", "wire", "latency")
    content: str  # names in comm.messages.CONTENTS, joined by ' and '
    wire: str = "intact"  # a name in comm.channel.WIRES
    latency: NonNegativeInt = LATENCY  # control steps


Directions = Annotated[int, Field(ge=1, le=64)]
Bits = Annotated[int, Field(ge=1, le=32)]
Quality = Annotated[int, Field(ge=1, le=100)]
Chance = Annotated[float, Field(ge=0, lt=1)]


class CodeConfig(Settings):
    """What is sent, and in how many bits."""

    kind: Literal["latent", "oracle", "raw", "jpeg", "jpeg, encoded"] = "latent"
    directions: Directions = 64  # principal ones of the latent; all 64: its own floats
    bits: Bits = 32  # of each float of the latent; 32: the float itself
    quality: Quality = 80  # of a JPEG


class LinkConfig(Settings):
    """How a message travels, and how long its receiver waits for it; the defaults are the paper's."""

    loss: Chance = 0.0  # share of messages lost
    memory: Chance = 0.0  # correlation of a message's fate with that of the one before
    latency: NonNegativeInt = LATENCY  # control steps
    reach: PositiveFloat | None = None  # metres; None: the layout's communication radius
    noise: float | None = None  # dB of the content's power over that of the noise on it; None: no noise
    patience: NonNegativeInt = 0  # control steps that the navigator waits for a message, beyond the commit step


class RadioConfig(DeciderSizes, Training):
    """Heads that read messages which travelled by radio."""

    decided = (*Training.decided, "code", "link")
    code: CodeConfig = CodeConfig()
    link: LinkConfig = LinkConfig()


class CrowdConfig(DeciderSizes, Training):
    """Heads that hear several scouts, of which one sees the slab and one may lie."""

    decided = (*Training.decided, "scouts", "liar", "latency")
    scouts: PositiveInt = 1
    liar: Literal["nobody", "elsewhere", "at the post"] = "nobody"
    latency: NonNegativeInt = LATENCY  # control steps

    @model_validator(mode="after")
    def _room_for_a_liar(self) -> "CrowdConfig":
        if self.liar != "nobody" and self.scouts < 2:
            raise ValueError("a liar is a second scout; expected at least 2 scouts, got 1")
        return self


class LoopSizes(Settings):
    """How many scenes are seen and driven behind a camera, and what the surrogate camera is like."""

    draws: PositiveInt = 128  # of the scene, that scouts look at, under every placement
    driven: PositiveInt = 15  # the first of them, which are driven too, under every placement and route
    shards: PositiveInt = 3  # runs that driving is split into
    rows: PositiveInt = 10  # episodes side by side
    horizon: PositiveInt = 400  # control steps until the time-out
    optics: OpticsConfig = OpticsConfig()
    dim: NonNegativeFloat = 1.0  # stops by which the dim state's light is lowered, besides a lamp that is off

    @model_validator(mode="after")
    def _driven_are_seen(self) -> "LoopSizes":
        if not self.shards <= self.driven <= self.draws:
            raise ValueError(f"expected shards <= driven <= draws, got {self.shards}, {self.driven} and {self.draws}")
        return self


class SightConfig(Training):
    """What scouts send who look through one eye."""

    decided = (*Training.decided, "eye")
    eye: Literal["simulated", "even", "bright", "dim"]
    draws: PositiveInt
    optics: OpticsConfig
    dim: NonNegativeFloat  # stops


class DrivingConfig(SightConfig):
    """One shard of what navigators do who drive behind one eye."""

    driven: PositiveInt
    shards: PositiveInt
    rows: PositiveInt
    horizon: PositiveInt
    commit_step: NonNegativeInt  # control steps that the navigator waits


class LoopHeadConfig(DeciderSizes, Training):
    """Heads that are trained on simulated frames, floor and walls recoloured or not."""

    decided = (*Training.decided, "colour", "texture", "latency")
    colour: Share = 0.0
    texture: NonNegativeFloat = 0.0
    latency: NonNegativeInt = LATENCY  # control steps


class PatchSenderConfig(PatchEncoderConfig):
    """Training of one sender of the gridworld, on the paper's walks."""

    decided = (*PatchEncoderConfig.decided, "kind")
    kind: str = "jepa"  # a name in beyond.grid.GRID_SENDERS
    apart: PositiveInt = 4  # most steps between the two views of a contrastive pair
    temperature: PositiveFloat = 0.1  # of the contrastive loss


class GridReaderConfig(GridConfig):
    """The gridworld's receiver, trained on one sender."""

    decided = (*GridConfig.decided, "sender")
    sender: str  # what the scout sends; names the random stream


class VarianceConfig(Settings):
    """The split of the variance over layouts, encoders and heads."""

    layouts: Annotated[tuple[str, ...], Field(min_length=2)]
    encoders: Annotated[int, Field(ge=2)] = 5
    heads: Annotated[int, Field(ge=2)] = 5
    frames: PositiveInt = 51_200  # of each encoder's training
    draws: PositiveInt = 2_048  # of the scene


class ControlsConfig(Settings):
    """All settings of the controls in one parameter; heads and channel are those of `pixel_study`."""

    sender: SenderConfig = SenderConfig()
    gates: SenderGateConfig = SenderGateConfig()
    recoloured: SenderConfig = SenderConfig(frames=51_200)  # the second training, on frames in random colours
    colour: Share = 1.0  # of floor's and walls' colour that a random one replaces there
    drawn: PositiveInt = 3  # untrained encoders, and random projections
    repeats: PositiveInt = 2  # scenes per draw of the bank
    heads: PositiveInt = 5  # seeds
    share: Annotated[float, Field(gt=0, le=1)] = 0.1  # of the episodes that a second set of heads gets
    end_to_end: PositiveInt = 2  # seeds per rung of the sender that learns with its head
    variance: VarianceConfig
    grid_seeds: PositiveInt = 5
