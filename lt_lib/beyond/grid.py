"""The gridworld's twin of the controls: the same kinds of senders on patches of cells, read by the same receiver.

The navigator's own eyes are the paper's encoder throughout; only what the scout sends varies.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from sklearn.decomposition import PCA
from torch import Tensor, nn
from torch.nn import functional as F

from lt_lib import ppo
from lt_lib.beyond.senders import ALONE, Contrasting, Judging, cross_entropy_of_pairs, filled
from lt_lib.envs.layout import SIDES, load_layout
from lt_lib.gridworld.map import CODES, PATCH, Grid
from lt_lib.gridworld.mappo import Inputs, TableTeam, learn
from lt_lib.gridworld.patches import PatchEncoder, PatchProjection, Walk, random_walks, train_patch_encoder
from lt_lib.gridworld.views import Views, cells
from lt_lib.gridworld.wires import contents_sent
from lt_lib.perception.encoder import LATENT
from lt_lib.perception.objective import normalisation, optimise
from lt_lib.settings.beyond import GridReaderConfig, PatchSenderConfig
from lt_lib.settings.gridworld import GridConfig
from lt_lib.settings.streams import Stream
from lt_lib.store.states import state_of

VISITS = 8_192  # cells visited that the components and the normalisation are taken from


class Visits(NamedTuple):
    """The paper's random walks and every patch they can meet."""

    walk: Walk
    rows: Int[np.ndarray, "r t"]  # of the table of patches
    table: UInt8[np.ndarray, "views 15 15"]

    def seen(self, rng: np.random.Generator) -> UInt8[np.ndarray, "n 15 15"]:
        """The patches of VISITS steps of the walks."""
        return self.table[rng.choice(self.rows.ravel(), VISITS)]


def visits_of(config: PatchSenderConfig, seed: int) -> Visits:
    """The walks on which the paper's patch encoder of this seed is trained."""
    grid, rng = Grid(load_layout(config.layout)), Stream.PATCH_ENCODER.generator(seed)
    walk = random_walks(grid, config.frames // config.rollout, config.rollout, rng)
    return Visits(walk, walk.cells * len(SIDES) + walk.slab[:, None], grid.patches.reshape(-1, PATCH, PATCH))


def principal_components(config: PatchSenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """The 64 leading principal components of the one-hot cells."""
    visits = visits_of(config, seed)
    seen = F.one_hot(torch.from_numpy(visits.seen(Stream.SENDER.generator(seed))).long(), len(CODES))
    components = PCA(LATENT, svd_solver="covariance_eigh").fit(seen.flatten(1).numpy().astype(np.float64))
    return projection(components.components_, -components.components_ @ components.mean_, visits, seed)


def random_projection(config: PatchSenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """64 Gaussian combinations of the one-hot cells."""
    matrix = Stream.SENDER.generator(seed).normal(0, 1 / np.sqrt(LATENT), (LATENT, PATCH * PATCH * len(CODES)))
    return projection(matrix, np.zeros(LATENT), visits_of(config, seed), seed)


def silence(config: PatchSenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """Nothing, which must stay at chance."""
    return projection(np.zeros((LATENT, PATCH * PATCH * len(CODES))), np.zeros(LATENT), visits_of(config, seed), seed)


def projection(
    matrix: Float[np.ndarray, "64 d"], bias: Float[np.ndarray, "64"], visits: Visits, seed: int
) -> dict[str, np.ndarray]:
    """A linear sender, frozen."""
    return frozen_on(filled(PatchProjection(), matrix, bias), visits, seed)


def supervised(config: PatchSenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """The same encoder trained to name the blocked corridor."""
    visits = visits_of(config, seed)
    table, slab = torch.from_numpy(visits.table), torch.from_numpy(visits.walk.slab)

    def terms(model: Judging, r: Int[np.ndarray, " b"], t: Int[np.ndarray, " b"]) -> Float[Tensor, "1"]:
        return model.cross_entropy(table[visits.rows[r, t]], slab[r])

    return trained(lambda: Judging(PatchEncoder()), terms, visits, config, seed, report)


def contrastive(config: PatchSenderConfig, seed: int, *, report: Callable[[float], None]) -> dict:
    """SimCLR's code; a pair is two views of one walk, at most `config.apart` steps apart."""
    visits, rng = visits_of(config, seed), Stream.SENDER.generator(seed, "views")
    table, last = torch.from_numpy(visits.table), visits.rows.shape[1] - 1

    def terms(model: Contrasting, r: Int[np.ndarray, " b"], t: Int[np.ndarray, " b"]) -> Float[Tensor, "1"]:
        later = np.minimum(t + rng.integers(1, config.apart + 1, len(t)), last)
        codes = [model.head(model.encoder(table[visits.rows[r, each]])) for each in (t, later)]
        return cross_entropy_of_pairs(*codes, config.temperature)[None]

    return trained(lambda: Contrasting(PatchEncoder()), terms, visits, config, seed, report)


def trained(
    network: Callable[[], nn.Module],
    terms: Callable[..., Tensor],
    visits: Visits,
    config: PatchSenderConfig,
    seed: int,
    report: Callable[[float], None],
) -> dict:
    """Trains a network that has an `encoder` as the paper's patch encoder is trained; returns it frozen."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = network()
    rng, shape = Stream.SENDER.generator(seed), visits.rows.shape
    optimise(model, lambda r, t: terms(model, r, t), torch.ones(1), shape, config, rng, report)
    return frozen_on(model.encoder, visits, seed)


@torch.no_grad()
def frozen_on(network: nn.Module, visits: Visits, seed: int) -> dict[str, np.ndarray]:
    """A network's weights and the normalisation of its latents over visited cells."""
    seen = torch.from_numpy(visits.seen(Stream.SENDER.generator(seed, "normalisation")))
    return state_of(network, "E") | normalisation(network(seen).numpy())


class GridSender(NamedTuple):
    """How a sender's patch encoder is trained, and the settings in which its training differs from the others'."""

    train: Callable[..., dict]
    changes: Mapping[str, float]


# The paper's objective without its first three terms is an autoencoder.
GRID_SENDERS = {
    "jepa": GridSender(train_patch_encoder, {}),
    "no_reconstruction": GridSender(train_patch_encoder, {"reconstruction": 0.0}),
    "prediction": GridSender(train_patch_encoder, ALONE),
    "contrastive": GridSender(contrastive, {}),
    "autoencoder": GridSender(train_patch_encoder, {"prediction": 0.0, "variance": 0.0, "covariance": 0.0}),
    "pca": GridSender(principal_components, {}),
    "random": GridSender(random_projection, {}),
    "untrained": GridSender(train_patch_encoder, {"epochs": 0.0}),
    "supervised": GridSender(supervised, {}),
    "silence": GridSender(silence, {}),
}


def train_grid_reader(
    config: GridReaderConfig,
    seed: int,
    *,
    report: Callable[[float], None],
    encoder: Mapping[str, np.ndarray],
    sender: Mapping[str, np.ndarray],
) -> dict:
    """`gridworld.mappo.train_grid` with the navigator's eyes from one encoder and the scout's message from another."""
    grid, rng = Grid(load_layout(config.layout)), Stream.READER.generator(seed, "cells", config.sender)
    eyes = cells(grid, encoder)
    sent = contents_sent(grid, cells(grid, sender), "latent")
    inputs = Inputs.of(grid, eyes, "latent")
    inputs = inputs._replace(contents=torch.cat([torch.zeros_like(sent[:1]), sent]))
    return learn(ppo.built(lambda: TableTeam(inputs, config.value_gain), rng), grid, config, rng, report)


class TalkingTeam(TableTeam):
    """A team whose scout learns what to say: the policy's gradient reaches the sender's patch encoder."""

    def __init__(self, inputs: Inputs, views: Views):
        super().__init__(inputs)
        self.sender, self._posts = PatchEncoder(), torch.from_numpy(views.posts)  # (m, slab, h, w)

    def log_probs(self) -> Float[Tensor, "m p slab 5"]:
        said = self.sender(self._posts.flatten(0, 1)).unflatten(0, self._posts.shape[:2])  # (m, slab, 64)
        self.inputs = self.inputs._replace(contents=torch.cat([torch.zeros_like(said[:1]), said]))
        return super().log_probs()


def train_grid_end_to_end(
    config: GridConfig, seed: int, *, report: Callable[[float], None], encoder: Mapping[str, np.ndarray]
) -> dict:
    """The receiver and a sender that learns what to say from the receiver's policy gradient."""
    grid, rng = Grid(load_layout(config.layout)), Stream.READER.generator(seed, "cells", "end to end")
    eyes = cells(grid, encoder)
    inputs = Inputs.of(grid, eyes, "latent")
    return learn(ppo.built(lambda: TalkingTeam(inputs, eyes), rng), grid, config, rng, report)
