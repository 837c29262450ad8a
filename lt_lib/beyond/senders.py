"""Ten ways to turn a frame into 64 floats: trainings of senders that all freeze to the same form.

Each is a function of (config, seed) that returns "E.*" and the normalisation "mean", "std" (64,) over training frames.
Those that are trained see the same random rollouts as the paper's encoder, the same number of updates, the same rate.
To add one, write a function and list it in SENDERS.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from sklearn.decomposition import IncrementalPCA
from torch import Tensor, nn
from torch.nn import functional as F

from lt_lib.envs.layout import load_layout
from lt_lib.perception.appearance import draw_appearances, eight_bits, recoloured
from lt_lib.perception.encoder import LATENT, Encoder
from lt_lib.perception.frames import hazard_visible, random_rollouts, wall_pixels
from lt_lib.perception.gates import probes
from lt_lib.perception.jepa import train_encoder
from lt_lib.perception.objective import normalisation, optimise
from lt_lib.perception.pictures import (
    PIXELS,
    PictureEncoder,
    Pictures,
    Projection,
    draw_pictures,
    fit_pictures,
)
from lt_lib.settings.beyond import SenderConfig, SenderGateConfig
from lt_lib.settings.streams import Stream
from lt_lib.store.states import only, state_of

Terms = Callable[[Int[np.ndarray, " b"], Int[np.ndarray, " b"]], Float[Tensor, " k"]]
BATCH = 512  # frames per step of the incremental principal components


def frames_of(config: SenderConfig, seed: int) -> Pictures:
    """The training frames of a seed: those of the paper's encoder, in the appearances of the configuration."""
    return draw_pictures(config, Stream.ENCODER.generator(seed))


def jepa(config: SenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """The paper's objective, with whatever weights its four terms have; untrained after 0 epochs."""
    if config.colour or config.texture:
        return fit_pictures(frames_of(config, seed), config, seed, Stream.SENDER.generator(seed), report)
    return train_encoder(config, seed, report=report)  # the paper's own training, which knows the few colours


def principal_components(config: SenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """The 64 leading principal components of the pixels, from every `config.every`th frame of each rollout."""
    pictures, components = frames_of(config, seed), IncrementalPCA(LATENT, batch_size=BATCH)
    number, length = pictures.shape
    r, t = (axis.ravel() for axis in np.meshgrid(np.arange(number), np.arange(0, length, config.every)))
    order = Stream.SENDER.generator(seed).permutation(len(r))
    for start in range(0, len(order), BATCH):
        pick = order[start : start + BATCH]
        if len(pick) >= LATENT:  # fewer frames than components cannot be taken in
            components.partial_fit(pictures.colours(r[pick], t[pick]).reshape(len(pick), -1))
        report(min(1.0, (start + BATCH) / len(order)))
    return projection(components.components_, -components.components_ @ components.mean_, pictures, seed)


def random_projection(config: SenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """64 Gaussian combinations of the pixels (Johnson and Lindenstrauss)."""
    matrix = Stream.SENDER.generator(seed).normal(0, 1 / np.sqrt(LATENT), (LATENT, PIXELS * PIXELS * 3))
    return projection(matrix, np.zeros(LATENT), frames_of(config, seed), seed)


def silence(config: SenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """Nothing: the control of the controls, which must stay at chance on every rung."""
    return projection(np.zeros((LATENT, PIXELS * PIXELS * 3)), np.zeros(LATENT), frames_of(config, seed), seed)


def projection(
    matrix: Float[np.ndarray, "64 d"], bias: Float[np.ndarray, "64"], pictures: Pictures, seed: int
) -> dict[str, np.ndarray]:
    """A linear sender, frozen."""
    return frozen_on(filled(Projection(), matrix, bias), pictures, Stream.SENDER.generator(seed))


@torch.no_grad()
def filled(network: nn.Module, matrix: Float[np.ndarray, "64 d"], bias: Float[np.ndarray, "64"]) -> nn.Module:
    """A network with one `linear` layer, which gets this matrix and bias."""
    network.linear.weight.copy_(torch.from_numpy(matrix))
    network.linear.bias.copy_(torch.from_numpy(bias))
    return network


class Autoencoder(nn.Module):
    """The encoder, and a decoder to means over 4 x 4 pixels, as fine as the paper's auxiliary read-out."""

    def __init__(self):
        super().__init__()
        self.encoder = Encoder()
        self.decoder = nn.Sequential(
            nn.Linear(LATENT, 1024),
            nn.Unflatten(1, (64, 4, 4)),
            nn.ReLU(),
            nn.ConvTranspose2d(64, 32, kernel_size=4, stride=2, padding=1),
            nn.ReLU(),  # (B, 32, 8, 8)
            nn.ConvTranspose2d(32, 3, kernel_size=4, stride=2, padding=1),
        )

    def loss(self, pictures: Float[Tensor, "b 64 64 3"]) -> Float[Tensor, "1"]:
        """Mean squared error of the rebuilt means."""
        means = F.avg_pool2d(pictures.permute(0, 3, 1, 2), 4)  # (B, 3, 16, 16)
        return F.mse_loss(self.decoder(self.encoder(pictures)), means)[None]


def autoencoder(config: SenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """The code of a convolutional autoencoder, by squared error."""

    def terms(model: Autoencoder, pictures: Pictures) -> Terms:
        return lambda r, t: model.loss(torch.from_numpy(pictures.colours(r, t)).to(config.device))

    return trained(Autoencoder, terms, config, seed, report)


class Judging(nn.Module):
    """An encoder and one logit: whether the slab stands in the right corridor."""

    def __init__(self, encoder: nn.Module):
        super().__init__()
        self.encoder, self.logit = encoder, nn.Linear(LATENT, 1)

    def cross_entropy(self, seen: Tensor, slab: Int[Tensor, " b"]) -> Float[Tensor, "1"]:
        """Of the blocked corridor, from what the encoder takes."""
        logits = self.logit(self.encoder(seen)).squeeze(1)
        return F.binary_cross_entropy_with_logits(logits, slab.float())[None]

    def loss(self, pictures: Pictures, r: Int[np.ndarray, " b"], t: Int[np.ndarray, " b"]) -> Float[Tensor, "1"]:
        """`cross_entropy` in frames t of rollouts r."""
        device, slab = self.logit.weight.device, pictures.rollouts.slab[r]
        return self.cross_entropy(*(torch.from_numpy(each).to(device) for each in (pictures.colours(r, t), slab)))


def supervised(config: SenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """The same encoder trained to name the blocked corridor, which needs labels; most frames do not show it."""

    def terms(model: Judging, pictures: Pictures) -> Terms:
        return lambda r, t: model.loss(pictures, r, t)

    return trained(lambda: Judging(Encoder()), terms, config, seed, report)


def supervised_where_it_shows(config: SenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """As `supervised`, from frames that show the slab alone: others say nothing of where it stands."""
    rng = Stream.SENDER.generator(seed, "showing")

    def terms(model: Judging, pictures: Pictures) -> Terms:
        showing = np.argwhere(hazard_visible(pictures.rollouts.frames))  # (frames, 2): rollout, time

        def loss(r: Int[np.ndarray, " b"], _: Int[np.ndarray, " b"]) -> Float[Tensor, "1"]:
            return model.loss(pictures, *rng.choice(showing, len(r)).T)

        return loss

    return trained(lambda: Judging(Encoder()), terms, config, seed, report)


class Contrasting(nn.Module):
    """An encoder and the head on which the contrastive loss is taken (SimCLR)."""

    def __init__(self, encoder: nn.Module):
        super().__init__()
        self.encoder = encoder
        self.head = nn.Sequential(nn.ReLU(), nn.Linear(LATENT, 128), nn.ReLU(), nn.Linear(128, LATENT))


def contrastive(config: SenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """SimCLR's code; a pair is two frames of one rollout, at most `config.apart` steps apart."""
    rng = Stream.SENDER.generator(seed, "views")

    def terms(model: Contrasting, pictures: Pictures) -> Terms:
        last = pictures.shape[1] - 1

        def loss(r: Int[np.ndarray, " b"], t: Int[np.ndarray, " b"]) -> Float[Tensor, "1"]:
            later = np.minimum(t + rng.integers(1, config.apart + 1, len(t)), last)
            views = np.concatenate([pictures.colours(r, t), pictures.colours(r, later)])  # (2 B, h, w, 3)
            codes = model.head(model.encoder(torch.from_numpy(views).to(config.device)))
            return cross_entropy_of_pairs(*codes.chunk(2), config.temperature)[None]

        return loss

    return trained(lambda: Contrasting(Encoder()), terms, config, seed, report)


def cross_entropy_of_pairs(
    one: Float[Tensor, "b d"], other: Float[Tensor, "b d"], temperature: float
) -> Float[Tensor, ""]:
    """SimCLR's loss: each view must pick its partner among all other views of the batch by cosine similarity."""
    codes = F.normalize(torch.cat([one, other]), dim=1)  # (2 B, d)
    similarity = (codes @ codes.T / temperature).fill_diagonal_(-torch.inf)
    partner = torch.arange(len(codes), device=codes.device).roll(len(one))
    return F.cross_entropy(similarity, partner)


def trained(
    network: Callable[[], nn.Module],
    terms: Callable[[nn.Module, Pictures], Terms],
    config: SenderConfig,
    seed: int,
    report: Callable[[float], None],
) -> dict:
    """Trains a network that has an `encoder` as stage 1 does the paper's; returns it frozen, and "loss" (updates,)."""
    pictures, rng = frames_of(config, seed), Stream.SENDER.generator(seed)
    with torch.random.fork_rng(devices=[]):  # module initialisation draws from torch's global generator
        torch.manual_seed(seed)
        model = network().to(config.device)
    scale = torch.ones(1, device=config.device)
    curve = optimise(model, terms(model, pictures), scale, pictures.shape, config, rng, report)
    return frozen_on(model.encoder, pictures, rng) | {"loss": curve[:, 0].copy()}


@torch.no_grad()
def frozen_on(network: nn.Module, pictures: Pictures, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """A network's weights and the normalisation of its latents over a sample of pictures."""
    device = next(network.parameters()).device
    latents = network(torch.from_numpy(pictures.sample(rng)).to(device)).cpu().numpy()
    return state_of(network, "E") | normalisation(latents)


def frozen(sender: Mapping[str, Any]) -> dict[str, Any]:
    """What a trained sender needs to send: E and the normalisation."""
    return only(sender, "E") | {name: sender[name] for name in ("mean", "std")}


class Sender(NamedTuple):
    """What a sender is called, how it is trained, and the settings in which its training differs from the others'."""

    words: str
    train: Callable[..., dict]
    changes: Mapping[str, float] = MappingProxyType({})


FEW = {"frames": 20_480}  # rollouts are drawn in blocks, so these are the first of all; enough to standardise by
ALONE = {"variance": 0.0, "covariance": 0.0, "reconstruction": 0.0}
SENDERS = {
    "jepa": Sender("JEPA latent (the paper's)", jepa),
    "no_reconstruction": Sender("JEPA without reconstruction", jepa, {"reconstruction": 0.0}),
    "prediction": Sender("prediction alone", jepa, ALONE),
    "contrastive": Sender("contrastive code (SimCLR)", contrastive),
    "autoencoder": Sender("autoencoder's code", autoencoder),
    "pca": Sender("64 principal components", principal_components),
    "random": Sender("random projection", random_projection, FEW),
    "untrained": Sender("untrained encoder", jepa, {"epochs": 0.0, **FEW}),
    "supervised": Sender("supervised on the hazard bit", supervised),
    "supervised_showing": Sender("supervised where the slab shows", supervised_where_it_shows),
    "silence": Sender("silence", silence, FEW),
}


def measure_sender(
    config: SenderGateConfig, seed: int, *, report: Callable[[float], None], sender: Mapping[str, np.ndarray]
) -> dict:
    """The fields of `perception.gates.Measured` for one sender, on held-out rollouts that look like its training's."""
    rng = Stream.SENDER_GATES.generator(seed)
    rollouts = random_rollouts(load_layout(config.layout), config.rollouts, config.length, rng)
    looks = draw_appearances(config.rollouts, PIXELS, config.colour, config.texture, rng)
    network = PictureEncoder(sender, config.device)
    steps = np.swapaxes(rollouts.frames, 0, 1)  # (t, r, h, w)
    latents = np.stack([network.latents(eight_bits(recoloured(frames, looks))) for frames in steps], axis=1)
    visible, walls = hazard_visible(rollouts.frames), wall_pixels(rollouts.frames)
    return probes(latents, visible, walls)._asdict()
