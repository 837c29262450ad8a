"""What encoders show in notebooks: the losses of their training, and whether their guards keep the rank up."""

from collections.abc import Collection
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lt_lib.perception.gates import effective_rank
from lt_lib.report import judges, stats
from lt_lib.report.stats import ALPHA
from lt_lib.report.style import ROLES
from lt_lib.store.run import Result

PARTS = 6  # groups of rollouts, each with an effective rank of its own


TERMS = ("prediction", "variance", "covariance", "reconstruction")  # of the objective


def loss_curves(whole: Result, rival: Result, name: str, trained: Collection[str]) -> Figure:
    """Each term of the objective, before weighting, against the update, on a log scale.

    whole, rival  trainings by all TERMS and by some; each has "loss.*" (updates,)
    trained       the terms of the rival's objective; the others are dashed, since nothing lowers them
    """
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    for axes, term in zip(figure.subplots(1, len(TERMS)), TERMS, strict=True):
        _curve(axes, whole[f"loss.{term}"], "ours", "-", "the whole objective")
        _curve(axes, rival[f"loss.{term}"], "upper bound", "-" if term in trained else "--", name)
        axes.set(title=term if term in trained else f"{term}\n(dashed: not in its objective)", xlabel="update")
    figure.axes[0].legend()
    figure.supylabel("loss, mean of 10 updates")
    return figure


def _curve(axes: Axes, loss: Float[np.ndarray, " updates"], role: str, dash: str, name: str) -> None:
    smooth = pd.Series(np.maximum(loss, 1e-8)).rolling(10, min_periods=1).mean()  # a log axis has no zero
    axes.semilogy(smooth.index, smooth, color=ROLES[role], ls=dash, lw=1.2, label=name)


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
