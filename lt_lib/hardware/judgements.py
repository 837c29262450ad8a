"""What the decode is judged by: the registered rule, a rule of red pixels, and accuracy under camera effects."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import mannwhitneyu

from lt_lib.hardware.probe import CameraTransfer, decoded, fit_probe, red_shares
from lt_lib.hardware.sessions import Session
from lt_lib.perception.pictures import PictureEncoder
from lt_lib.report import judges, stats
from lt_lib.report.stats import ALPHA
from lt_lib.store.run import Result

Scores = Float[np.ndarray, " _n"]
APPEARANCE = 0.25  # R^2 of colours on the latent below which appearance counts as dropped


def registered_rule(transfer: CameraTransfer, gate: float) -> str:
    """What the registered rule keeps, in words, and what the other probe would do live."""
    first = transfer.decoded(transfer.simulated, "refit").balanced
    kept = transfer.registered(gate) is transfer.simulated
    other = transfer.refit if kept else transfer.simulated
    names = ("the probe fitted in simulation", "the refit probe")
    return (
        f"the registered rule keeps {names[not kept]} ({first:.3f} on the refit session for that of simulation, gate "
        f"{gate}); {names[kept]} has a live balanced accuracy of {transfer.decoded(other, 'live').balanced:.3f}"
    )


def by_answer(scores: Float[np.ndarray, " n"], hazard: Bool[np.ndarray, " n"]) -> tuple[Scores, Scores]:
    """Scores of hazard frames and of clear ones, the two samples of the judges below."""
    return scores[hazard], scores[~hazard]


def direction(hazard: Scores, clear: Scores) -> dict[str, Any]:
    """AUC of a probe's scores; holds if hazard frames score above clear ones (Mann-Whitney)."""
    tested = mannwhitneyu(hazard, clear, alternative="greater")
    auc, p = float(tested.statistic / (len(hazard) * len(clear))), float(tested.pvalue)
    found = {"value": auc, "n": len(hazard) + len(clear), "p": p}
    return found | {"test": "Mann-Whitney: hazard above clear", "holds": p < ALPHA}


def threshold_lost(hazard: Scores, clear: Scores) -> dict[str, Any]:
    """Balanced accuracy at the simulated threshold; holds if it is at chance, within judges.AT_CHANCE."""
    value = _balanced(hazard, clear)
    test = f"balanced accuracy within 0.5 ± {judges.AT_CHANCE}"
    found = {"value": value, "n": len(hazard) + len(clear)}
    return found | {"test": test, "holds": abs(value - 0.5) <= judges.AT_CHANCE}


def decodes(hazard: Scores, clear: Scores, *, gate: float) -> dict[str, Any]:
    """Balanced accuracy; holds if it reaches `gate`."""
    value = _balanced(hazard, clear)
    found = {"value": value, "n": len(hazard) + len(clear)}
    return found | {"test": f"balanced accuracy from {gate}", "holds": value >= gate}


def decisions(hazard: Scores, clear: Scores, *, gate: float) -> dict[str, Any]:
    """Decisions decoded, as a count; holds if the balanced accuracy reaches the gate."""
    right, n = int((hazard > 0).sum() + (clear <= 0).sum()), len(hazard) + len(clear)
    low, high = stats.wilson(right, n)
    return decodes(hazard, clear, gate=gate) | {"value": f"{right} of {n}", "low": low, "high": high}


def _balanced(hazard: Scores, clear: Scores) -> float:
    return float(((hazard > 0).mean() + (clear <= 0).mean()) / 2)


def bang_bang(past: Float[np.ndarray, "routes axes"]) -> dict[str, Any]:
    """The smallest and the largest share of an action component past the rails; holds if most of each is."""
    share = past.mean(axis=0)
    test = "more than half, every component"
    return {"value": judges.ends(share), "n": past.size, "test": test, "holds": bool(share.min() > 0.5)}


def drops_appearance(appearance: Float[np.ndarray, " n"], geometry: Float[np.ndarray, " n"]) -> dict[str, Any]:
    """Whether encoders keep geometry and drop appearance: R^2 of colours below that of the wall count."""
    p = stats.rank_test(geometry, appearance)
    means = f"{appearance.mean():.3f} for colours, {geometry.mean():.3f} for the wall count"
    test = f"exact rank test of R² over encoders, colours below {APPEARANCE}: {means}"
    return judges.words(p < ALPHA and appearance.mean() < APPEARANCE, test, p=p, n=len(geometry))


def red_scores(session: Session, ratio: float, share: float) -> Scores:
    """Positive where more than `share` of a frame's pixels is red: the rule that such a frame shows the hazard.

    ratio  a pixel is red if its red exceeds this many times the larger of its green and blue
    """
    return red_shares(session.frames, ratio) - share


def under_effects(encoder: Result, refit: Session, sweeps: Mapping[str, Result]) -> dict[str, Float[np.ndarray, " s"]]:
    """Balanced accuracy at each strength of each effect, of the probe fitted to a refit session.

    sweeps  results of `film_sweep` by effect
    """
    network = PictureEncoder(encoder)
    probe = fit_probe(network.latents(refit.frames), refit.hazard)

    def accuracy(frames, hazard) -> float:
        return decoded(probe.scores(network.latents(frames)), hazard).balanced

    return {
        effect: np.array([accuracy(frames, sweep["hazard"]) for frames in sweep["frames"]])
        for effect, sweep in sweeps.items()
    }
