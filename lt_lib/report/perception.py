"""The loss curves of an encoder's training, which the pixel and the gridworld sections both show."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lt_lib.report.style import ROLES
from lt_lib.store.run import Result


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
