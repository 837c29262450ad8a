"""Figures and the table of the encoder's section: what it sees, how it learns, what its latent holds."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from jaxtyping import Float, UInt8
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from lt_lib.envs.camera import colours
from lt_lib.perception.frames import hazard_visible
from lt_lib.perception.jepa import GRID, colour_classes
from lt_lib.report.style import ROLES
from lt_lib.store.run import Result


def training_frames(frames: UInt8[np.ndarray, "n h w"]) -> Figure:
    """Frames of random rollouts above, and below what the read-out is asked for: quantised colours on a coarse grid."""
    figure = Figure(figsize=(12, 2.6), layout="constrained")
    panels = figure.subplots(2, len(frames))
    step = frames.shape[-1] // GRID
    classes = colour_classes()
    palette = ListedColormap(
        [colours(np.array([[np.flatnonzero(classes == c)[0]]], np.uint8))[0, 0] / 255 for c in range(classes.max() + 1)]
    )
    for (upper, lower), frame in zip(panels.T, frames, strict=True):
        upper.imshow(colours(frame))
        lower.imshow(
            classes[frame[step // 2 :: step, step // 2 :: step]],
            cmap=palette,
            vmin=-0.5,
            vmax=classes.max() + 0.5,
        )
        upper.set_title("hazard in view" if hazard_visible(frame) else "", fontsize=8, color="#B22222")
        for axes in (upper, lower):
            axes.set(xticks=[], yticks=[])
    panels[0, 0].set_ylabel("frame\n64 x 64")
    panels[1, 0].set_ylabel(f"its own colours\n{GRID} x {GRID}")
    return figure


def loss_curves(encoders: Mapping[str, Result]) -> Figure:
    """Each term of the objective, before weighting, over updates; log scale."""
    terms = ("prediction", "variance", "covariance", "reconstruction")
    figure = Figure(figsize=(13, 3.2), layout="constrained")
    for axes, term in zip(figure.subplots(1, len(terms)), terms, strict=True):
        for (name, encoder), colour in zip(encoders.items(), (ROLES["ours"], ROLES["upper bound"]), strict=True):
            values = np.maximum(encoder[f"loss.{term}"], 1e-8)
            axes.semilogy(
                np.arange(len(values)),
                pd.Series(values).rolling(10, min_periods=1).mean(),
                color=colour,
                lw=1.2,
                label=name,
            )
        axes.set(title=term, xlabel="update")
    axes.legend(fontsize=8)
    figure.supylabel("loss, mean of 10 updates")
    return figure


def latent_map(report: Mapping[str, Float[np.ndarray, "n ..."]]) -> Figure:
    """A t-SNE of held-out frames' latents, coloured by where, which way, and whether the slab shows."""
    figure = Figure(figsize=(13, 4.4), layout="constrained")
    first, second, third = figure.subplots(1, 3, sharex=True, sharey=True)
    plane, pose, hazard = report["latent.plane"], report["latent.pose"], report["latent.hazard"].astype(bool)
    dots = {"s": 5, "lw": 0}
    heading = np.rad2deg(np.angle(np.exp(1j * pose[:, 2])))
    for axes, values, label, cmap in (
        (first, pose[:, 0], "x (m): barrier from -1.5 to 1.2", "viridis"),
        (second, heading, "heading (degrees)", "twilight"),
    ):
        figure.colorbar(axes.scatter(*plane.T, c=values, cmap=cmap, **dots), ax=axes, label=label)
    third.scatter(*plane[~hazard].T, color="0.75", label="no hazard in view", **dots)
    third.scatter(*plane[hazard].T, color="#B22222", label="hazard in view", **dots)
    third.legend(markerscale=3, fontsize=8)
    for axes in (first, second, third):
        axes.set(xticks=[], yticks=[], xlabel="t-SNE of the latent")
    return figure
