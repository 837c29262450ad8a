"""The freeze gates of the gridworld's encoder (Section Encoder and freeze), chosen so that random weights fail them.

There are few views, so a linear probe fitted on them all reads the hazard off any encoder, an untrained one too. The
probe is therefore tested on cells that it was not fitted on, and the hazard must also weigh in the latent: a message
that carries it as a whisper beside a large constant is a message that no policy learns to hear.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.stats import t
from sklearn.linear_model import LogisticRegression
from sklearn.manifold import TSNE
from sklearn.model_selection import GroupKFold, cross_val_score

from lt_lib.envs.layout import SIDES, load_layout
from lt_lib.gridworld.map import HAZARD, PATCH, Grid
from lt_lib.gridworld.patches import FrozenPatchEncoder
from lt_lib.perception.encoder import LATENT
from lt_lib.perception.gates import effective_rank, require
from lt_lib.settings.gridworld import PatchGateConfig, PatchGates


class PatchesMeasured(NamedTuple):
    """What `measure_patch_gates` found."""

    hazard: float  # accuracy of a linear hazard-visible probe in cells that it was not fitted on
    hazard_low: float  # 95% Student-t interval over folds
    hazard_high: float
    majority: float  # accuracy of always guessing the commoner answer
    share: float  # of the latent's variance over all views, what moving the slab does where it can be seen
    rank: float  # exponential of the entropy of the normalised singular values


def measure_patch_gates(
    config: PatchGateConfig, seed: int, *, report: Callable[[float], None], encoder: Mapping[str, np.ndarray]
) -> dict:
    """Probe, share and rank of a checkpoint over every view of the scene; also the latents' picture.

    Fields of `PatchesMeasured`, and "latent.plane" (n, 2) by t-SNE, "latent.hazard" (n,), "latent.cell" (n,).
    """
    grid = Grid(load_layout(config.layout))
    walked = np.flatnonzero(~grid.slab.any(0) & ~grid.goal)  # an episode ends in the others
    patches = grid.patches[walked]  # (n, 2, 15, 15)
    latents = FrozenPatchEncoder(encoder).latent(patches.reshape(-1, PATCH, PATCH)).numpy()
    visible = (patches == HAZARD).any((2, 3)).ravel()
    cells = np.repeat(walked, len(SIDES))
    folds = GroupKFold(config.folds, shuffle=True, random_state=seed)
    scores = cross_val_score(LogisticRegression(max_iter=5000), latents, visible, groups=cells, cv=folds)
    half = t.ppf(0.975, len(scores) - 1) * scores.std(ddof=1) / np.sqrt(len(scores))
    moved = latents.reshape(-1, len(SIDES), LATENT)[grid.revealing[walked]]
    between = np.square((moved[:, 0] - moved[:, 1]) / 2).sum(1).mean()
    found = PatchesMeasured(
        float(scores.mean()),
        float(max(scores.mean() - half, 0.0)),
        float(min(scores.mean() + half, 1.0)),
        float(max(visible.mean(), 1 - visible.mean())),
        float(between / latents.var(0).sum()),
        effective_rank(latents),
    )
    plane = TSNE(perplexity=min(15, len(latents) // 4), init="pca", random_state=0).fit_transform(latents)
    return found._asdict() | {"latent.plane": plane, "latent.hazard": visible, "latent.cell": cells}


def require_patch_gates(found: Mapping[str, float], gates: PatchGates) -> None:
    """Raises GateError unless the checkpoint passes every pre-registered gate."""
    require(
        found,
        {
            "hazard": ("hazard-visible probe in unseen cells", max(gates.hazard, found["majority"])),
            "share": ("hazard's share of the latent's variance", gates.share),
            "rank": ("effective rank", gates.rank),
        },
    )
