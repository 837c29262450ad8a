"""Route heads that learn to read a sender on a rung of the ladder, all on one episode bank (Section Route head)."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from sklearn.linear_model import LogisticRegression
from torch import Tensor

from lt_lib import ppo
from lt_lib.beyond.ladder import Scenes, draw_ladder_scenes, label
from lt_lib.comm.channel import ANCHOR
from lt_lib.comm.route_head import Chooser, RouteHead
from lt_lib.envs.layout import SIDES, load_layout
from lt_lib.perception.encoder import LATENT, Encoder
from lt_lib.perception.objective import normalisation
from lt_lib.perception.pictures import PIXELS, SAMPLE, PictureEncoder
from lt_lib.pixels.episodes import Outcomes, held_out_draws
from lt_lib.pixels.route import Bank, channel_of, learn
from lt_lib.settings.beyond import EndToEndConfig, ReaderConfig
from lt_lib.settings.streams import Stream
from lt_lib.store.states import state_of

PROBED = 4_096  # frames that a linear probe is fitted on, at most


class Split(NamedTuple):
    """Scenes that heads train on, and scenes that they are tested on."""

    training: Bank
    held_out: Bank


def scenes_of(config: ReaderConfig, bank: Mapping[str, np.ndarray]) -> Scenes:
    """The scenes of a rung, `config.repeats` per draw of the bank; the same for every sender."""
    rng = Stream.LADDER.generator(0, label(config.rung))
    spawn = np.tile(bank["spawn"], (config.repeats, 1))
    return draw_ladder_scenes(load_layout(config.layout), config.rung, spawn, rng)


def split(config: ReaderConfig, bank: Mapping[str, np.ndarray], scenes: Scenes, contents: Tensor) -> Split:
    """Banks of what is sent in each scene, of the bank's training draws and of its held-out ones."""
    outcomes = Outcomes(**{name: np.tile(bank[name], (config.repeats, 1, 1)) for name in Outcomes._fields})
    blocks = load_layout(config.layout).blocks
    whole = Bank(contents, scenes.scout[:, :2], scenes.spawn[:, :2], outcomes, blocks, bank["commit_step"])
    held_out = np.tile(np.arange(len(bank["spawn"])) < held_out_draws(bank), config.repeats)
    return Split(whole.take(~held_out), whole.take(held_out))


def train_readers(
    config: ReaderConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    bank: Mapping[str, np.ndarray],
    sender: Mapping[str, np.ndarray],
) -> dict:
    """Heads of `config.heads` seeds that read one sender on one rung.

    "optimal"             (heads, episodes) of sampled choices, in order
    "greedy", "few"       (heads, scenes) of greedy choices on held-out scenes, each under both placements: after all
                          episodes, and of other heads after `config.share` of them
    "probe"               accuracy of a linear probe of the blocked corridor on what is sent in held-out scenes
    """
    scenes = scenes_of(config, bank)
    contents = sent(PictureEncoder(sender, config.device), scenes.pictures)
    training, held_out = split(config, bank, scenes, contents)
    few = config.model_copy(update={"episodes": max(1, round(config.share * config.episodes))})
    heads = []
    for head in range(config.heads):
        heads.append([read(each, head, training, held_out) for each in (config, few)])
        report((head + 1) / config.heads)
    whole, brief = zip(*heads, strict=True)
    return {
        "optimal": np.stack([optimal for optimal, _ in whole]),
        "greedy": np.stack([greedy for _, greedy in whole]),
        "few": np.stack([greedy for _, greedy in brief]),
        "probe": probe(training.contents, held_out.contents),
    }


def sent(sender: PictureEncoder, pictures: UInt8[np.ndarray, "e slab h w 3"]) -> Float[Tensor, "e slab 64"]:
    """What a sender makes of the pictures of every scene."""
    latents = sender.latents(pictures.reshape(-1, *pictures.shape[2:]))
    return torch.from_numpy(latents).unflatten(0, pictures.shape[:2])


def read(
    config: ReaderConfig, seed: int, training: Bank, held_out: Bank
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " scenes"]]:
    """Trains one head; returns whether each training episode's route was the free one, and `greedy_choices`."""
    rng = Stream.READER.generator(seed, config.sender, label(config.rung), str(config.episodes))
    head = ppo.built(lambda: RouteHead(ANCHOR + LATENT), rng)
    optimiser = torch.optim.Adam(head.parameters(), lr=config.lr, eps=1e-5, fused=True)
    channel = channel_of(config, config.batch, LATENT, rng)
    course = learn(head, optimiser, training, channel, config, rng, lambda _: None)
    return course["optimal"], greedy_choices(config, head, held_out, rng)


def greedy_choices(
    config: ReaderConfig, head: Chooser, held_out: Bank, rng: np.random.Generator
) -> Bool[np.ndarray, " scenes"]:
    """Whether the likelier route is the free one, in every held-out scene under both placements.

    A head that always takes the same corridor, or that reads nothing, is right in one half.
    """
    entry, slab = (axis.ravel() for axis in np.indices(held_out.contents.shape[:2]))
    channel = channel_of(config, len(entry), held_out.contents.shape[-1], rng)
    return ~held_out.blocks[slab, head.greedy(held_out.wires(channel, entry, slab))]


def probe(training: Float[Tensor, "e slab c"], held_out: Float[Tensor, "k slab c"]) -> float:
    """Accuracy on held-out scenes of a linear probe of the blocked corridor."""
    x, y = training.flatten(0, 1).numpy()[:PROBED], np.tile(np.arange(len(SIDES)), len(training))[:PROBED]
    fitted = LogisticRegression(max_iter=2000).fit(x, y)
    return float(fitted.score(held_out.flatten(0, 1).numpy(), np.tile(np.arange(len(SIDES)), len(held_out))))


class EndToEnd(Chooser):
    """A sender's encoder and the head that reads it as one policy on raw wires: anchor and picture."""

    def __init__(self):
        super().__init__()
        self.encoder, self.head = Encoder(), RouteHead(ANCHOR + LATENT)

    def said(self, pictures: Float[Tensor, "b d"]) -> Float[Tensor, "b 64"]:
        """The 64 floats that the sender makes of flattened pictures."""
        device = self.encoder.layers[0].weight.device
        return self.encoder(pictures.unflatten(1, (PIXELS, PIXELS, 3)).to(device)).cpu()

    def message(self, raw: Float[Tensor, "b w"]) -> Float[Tensor, "b 66"]:
        """What reaches the head: the anchor, and what the sender says."""
        return torch.cat([raw[:, :ANCHOR], self.said(raw[:, ANCHOR:])], dim=1)

    def outlook(self, observations: Float[Tensor, "b w"]):
        """The head's policy and value on the message; their gradient reaches the sender."""
        return self.head.outlook(self.message(observations))


def train_end_to_end(
    config: EndToEndConfig, seed: int, *, report: Callable[[float], None], bank: Mapping[str, np.ndarray]
) -> dict:
    """A sender that learns what to say from the receiver's policy gradient (DIAL, CommNet), on one rung.

    "E.*", "mean", "std"  the sender, frozen afterwards like any other
    "optimal"             (episodes,) of sampled choices, in order
    "greedy"              (scenes,) of greedy choices on held-out scenes, each under both placements
    """
    rng = Stream.READER.generator(seed, "end to end", label(config.rung))
    scenes = scenes_of(config, bank)
    raw = torch.from_numpy(scenes.pictures.reshape(*scenes.pictures.shape[:2], -1)).float() / 255
    training, held_out = split(config, bank, scenes, raw)
    policy = ppo.built(EndToEnd, rng)
    policy.encoder.to(config.device)
    groups = [{"params": policy.encoder.parameters(), "lr": config.sender_lr}, {"params": policy.head.parameters()}]
    optimiser = torch.optim.Adam(groups, lr=config.lr, eps=1e-5, fused=True)
    course = learn(
        policy, optimiser, training, channel_of(config, config.batch, raw.shape[-1], rng), config, rng, report
    )
    with torch.no_grad():
        seen = policy.said(training.contents.flatten(0, 1)[:SAMPLE])
    greedy = greedy_choices(config, policy, held_out, rng)
    kept = state_of(policy.encoder, "E") | normalisation(seen.numpy())
    return kept | {"optimal": course["optimal"], "greedy": greedy}
