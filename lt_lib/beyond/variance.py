"""How much of the spread of route optimality is the layout's, the encoder's and the head's."""

import warnings
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from statsmodels.regression.mixed_linear_model import MixedLM

from lt_lib.envs.layout import load_layout
from lt_lib.pixels.episodes import draw_scenes
from lt_lib.settings.pixels import BankConfig
from lt_lib.settings.streams import Stream

RESAMPLES = 200


def perfect_bank(layout: str, draws: int) -> dict:
    """A bank as of an executor that never fails: the free corridor succeeds, the blocked one does not.

    Executors are trained in the paper's layout alone; in others, what matters here is what the message says.
    """
    arena = load_layout(layout)
    scenes = draw_scenes(arena, draws, Stream.BANK.generator(0, layout))
    free = np.broadcast_to(~arena.blocks, (draws, *arena.blocks.shape))  # (draws, slab, route)
    nothing, taken = np.zeros(free.shape, np.int64), np.broadcast_to(np.arange(free.shape[2]), free.shape)
    default = BankConfig()
    return scenes._asdict() | {
        "success": free.copy(),
        "length": nothing,
        "contacts": nothing,
        "entered": taken.copy(),
        "commit_step": default.commit_step,
        "held_out": default.held_out,
    }


class Split(NamedTuple):
    """Variances of route optimality, and their shares of the sum."""

    layout: float
    encoder: float
    head: float

    @property
    def shares(self) -> "Split":
        total = sum(self)
        return Split(*(part / total if total else 0.0 for part in self))


def split_variance(values: Float[np.ndarray, "layouts encoders heads"]) -> Split:
    """Variances by a mixed-effects model: encoders nested in layouts, heads the residual (restricted likelihood)."""
    layouts, encoders, heads = values.shape
    table = pd.DataFrame(
        {
            "value": values.ravel(),
            "layout": np.repeat(np.arange(layouts), encoders * heads),
            "encoder": np.tile(np.repeat(np.arange(encoders), heads), layouts),
        }
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a share of zero lies on the boundary, of which the optimiser warns
        fitted = MixedLM.from_formula(
            "value ~ 1", table, groups="layout", re_formula="1", vc_formula={"encoder": "0 + C(encoder)"}
        ).fit(reml=True)
    return Split(float(fitted.cov_re.iloc[0, 0]), float(fitted.vcomp[0]), float(fitted.scale))


def intervals(
    values: Float[np.ndarray, "layouts encoders heads"], rng: np.random.Generator, resamples: int = RESAMPLES
) -> Mapping[str, tuple[float, float]]:
    """95% intervals of the shares, by resampling from the fitted model (parametric bootstrap)."""
    fitted, (layouts, encoders, _), drawn = split_variance(values), values.shape, []
    shapes = (layouts, 1, 1), (layouts, encoders, 1), values.shape
    for _ in range(resamples):
        parts = (rng.normal(0, np.sqrt(part), shape) for part, shape in zip(fitted, shapes, strict=True))
        drawn.append(split_variance(sum(parts) + values.mean()).shares)
    low, high = np.percentile(drawn, [2.5, 97.5], axis=0)
    return {name: (float(a), float(b)) for name, a, b in zip(Split._fields, low, high, strict=True)}
