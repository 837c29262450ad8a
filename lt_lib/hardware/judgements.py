"""What the decode is judged by: the registered rule, a rule of red pixels, and accuracy under camera effects."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from lt_lib.hardware.matched import PictureEncoder
from lt_lib.hardware.probe import Transfer, decoded, fit_probe, red_shares
from lt_lib.hardware.sessions import Session
from lt_lib.store.run import Result


def registered_rule(transfer: Transfer, gate: float) -> str:
    """What the registered rule says of the probe fitted in simulation, judged on the refit session."""
    first = transfer.decoded(transfer.simulated, "refit").balanced
    if first < gate:
        return f"the registered fallback applies: {first:.3f} on the refit session misses the gate of {gate}"
    live = transfer.decoded(transfer.simulated, "live").balanced
    return (
        f"the registered rule would have kept the probe fitted in simulation ({first:.3f} on the refit session), "
        f"whose live balanced accuracy is {live:.3f}; the value is the refit probe's where there is one"
    )


def red_rule(session: Session, ratio: float, share: float) -> tuple[float, float]:
    """AUC and balanced accuracy of the rule that a frame shows the hazard if more than `share` of its pixels is red.

    ratio  a pixel is red if its red exceeds this many times the larger of its green and blue
    """
    return decoded(red_shares(session.frames, ratio) - share, session.hazard)


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
