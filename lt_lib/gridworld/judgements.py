"""The verdicts of the gridworld under corruption: policies that fall, that peek, and that must not change.

Samples are arrays (policies, episodes), one per wire of CORRUPTIONS, intact first.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from lt_lib.comm.channel import CORRUPTIONS
from lt_lib.report import judges, stats
from lt_lib.report.stats import ALPHA
from lt_lib.store.run import Result

Played = Sequence[Mapping[str, Result]]
Sample = Float[np.ndarray, "_policies _episodes"]
COUNTED = ("latent", "predicted", "raw")  # the paper's twelve: solved policies of these contents
SAME_WIRE = {"floor": ("content_zeroed", "sender_shuffled", "matched_noise")}  # these leave an empty content as it is
RETURNED = 0.6  # success of a policy that corruption has returned to chance, at most
REROUTES = 0.1  # share of episodes in both corridors from which a policy reroutes
UNCHANGED = 0.1  # success by which a negative control may differ, as judges.AT_CHANCE


def sampled(played: Played, what: str) -> list[Sample]:
    """'success', 'length' or 'rerouted' of every policy, its actions sampled, one array per wire."""
    return [np.array([row[wire][f"sampled.{what}"] for row in played], dtype=float) for wire in CORRUPTIONS]


def kept_rows(played: Mapping[str, Played], flags: Mapping[str, Bool[np.ndarray, " policies"]]) -> dict[str, Played]:
    """The rows of `played` that the flags keep, content by content."""
    return {name: [row for row, keep in zip(rows, flags[name], strict=True) if keep] for name, rows in played.items()}


def returned(intact: Sample, *destroyed: Sample) -> dict[str, Any]:
    """How many solved policies fall to chance under every destroyed wire; holds if that is most of them."""
    best = np.max([each.mean(axis=1) for each in destroyed], axis=0)  # (policies,)
    fallen = int((best <= RETURNED).sum())
    low, _ = stats.wilson(fallen, len(best))
    return {
        "value": f"{fallen} of {len(best)}",
        "n": len(best),
        "test": f"success at most {RETURNED} under every destroyed wire; 95% interval of the share above 0.5",
        "holds": low > 0.5,
        "note": f"the best of them under any destroyed wire has {best.max():.2f}, intact {intact.mean():.2f}",
    }


def peeks(rerouted: Sample, *destroyed: Sample) -> Bool[np.ndarray, " policies"]:
    """Which policies keep their success under every destroyed wire, and enter both corridors with the wire intact."""
    least = np.min([each.mean(axis=1) for each in destroyed], axis=0)  # (policies,)
    return (least > RETURNED) & (rerouted.mean(axis=1) >= REROUTES)


def peeking(rerouted: Sample, *destroyed: Sample) -> dict[str, Any]:
    """How many solved policies peek; holds if any does."""
    found = int(peeks(rerouted, *destroyed).sum())
    return {
        "value": found,
        "n": len(rerouted),
        "test": "keeps its success without the message, and enters both corridors",
        "holds": found > 0,
        "note": f"with the wire intact no solved policy reroutes in more than {rerouted.mean(axis=1).max():.2f} of its "
        "episodes",
    }


def longer_episodes(peekers: Sample, others: Sample) -> dict[str, Any]:
    """Whether policies that peek are visible in their episode length, beside solved ones that do not."""
    if not len(peekers):
        return judges.words(False, "no solved policy peeks, so none can be seen", n=max(1, len(others)))
    p = stats.rank_test(peekers.mean(axis=1), others.mean(axis=1))
    return judges.words(p < ALPHA, "exact rank test of mean episode lengths", p=p, n=len(peekers))


def changes(failed: Mapping[str, Played]) -> list[Sample]:
    """What a destroyed wire changes in the success of never-solved policies, episode by episode: -1, 0 or 1.

    One array per content and wire, without the wires that leave a content as it is.
    """
    return [
        after - before
        for name, rows in failed.items()
        if rows
        for before, *rest in [sampled(rows, "success")]
        for wire, after in zip(list(CORRUPTIONS)[1:], rest, strict=True)
        if wire not in SAME_WIRE.get(name, ())
    ]


def unchanged(*changed: Sample) -> dict[str, Any]:
    """Whether never-solved policies keep their success under every destroyed wire, by paired episodes.

    Every content and wire must be equivalent to the intact wire within UNCHANGED (TOST, seeds as units); p is the
    largest. The least McNemar p of a single policy stands in the note.
    """
    p = max(stats.equivalence(each, 0.0, UNCHANGED) for each in changed)
    single = [stats.sign_test(int((row > 0).sum()), int((row < 0).sum())) for each in changed for row in each]
    return {
        "value": "all" if p < ALPHA else "not all",
        "n": len(single),
        "test": f"equivalence of paired episodes ± {UNCHANGED} (TOST), every content and wire; the largest p",
        "p": p,
        "holds": p < ALPHA,
        "note": f"least McNemar p of {len(single)} policies and wires {min(single):.2g}; Bonferroni asks for "
        f"{ALPHA / len(single):.2g}",
    }
