"""What encoders show in notebooks: the losses of their training, and whether their guards keep the rank up."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure

from lt_lib.perception.gates import effective_rank
from lt_lib.report import judges, stats
from lt_lib.report.stats import ALPHA
from lt_lib.report.style import ROLES
from lt_lib.store.run import Result

PARTS = 6  # groups of rollouts, each with an effective rank of its own


def loss_curves(encoders: Mapping[str, Result]) -> Figure:
    """Each term of the objective, before weighting, against the update, on a log scale.

    encoders  two results by name: ours first, then its rival; each has "loss.*" (updates,)
    """
    terms = ("prediction", "variance", "covariance", "reconstruction")
    figure = Figure(figsize=(13, 3.2), layout="constrained")
    for axes, term in zip(figure.subplots(1, len(terms)), terms, strict=True):
        for (name, encoder), role in zip(encoders.items(), ("ours", "upper bound"), strict=True):
            values = np.maximum(encoder[f"loss.{term}"], 1e-8)  # a log axis has no zero
            smooth = pd.Series(values).rolling(10, min_periods=1).mean()
            axes.semilogy(smooth.index, smooth, color=ROLES[role], lw=1.2, label=name)
        axes.set(title=term, xlabel="update")
    axes.legend(fontsize=8)
    figure.supylabel("loss, mean of 10 updates")
    return figure


def rank_falls(
    guarded: Float[np.ndarray, "rollouts frames d"], bare: Float[np.ndarray, "rollouts frames d"], *, of: str
) -> dict[str, Any]:
    """Whether latents have a higher effective rank than others, over groups of rollouts (exact rank test)."""
    ranks = [
        [effective_rank(part.reshape(-1, part.shape[-1])) for part in np.array_split(side, PARTS)]
        for side in (guarded, bare)
    ]
    p = stats.rank_test(*ranks)
    means = " and ".join(f"{np.mean(side):.1f}" for side in ranks)
    test = f"exact rank test over {PARTS} groups of rollouts, above {of}: {means}"
    return judges.words(p < ALPHA, test, p=p, n=len(guarded))
