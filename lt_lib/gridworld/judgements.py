"""The verdicts of the gridworld under corruption: policies that fall, that peek, and that must not change."""

from collections.abc import Mapping, Sequence
from typing import Any

from lt_lib.comm.channel import CORRUPTIONS
from lt_lib.report import stats
from lt_lib.report.shares import SOLVED, final_shares
from lt_lib.store.run import Result

Policies = Mapping[str, Sequence[Result]]
Played = Mapping[str, Sequence[Mapping[str, Result]]]
DESTROYED = tuple(wire for wire in CORRUPTIONS if wire != "intact")
COUNTED = ("latent", "predicted", "raw")  # the paper's twelve: solved policies of these contents
RETURNED = 0.6  # success of a policy that corruption has returned to chance, at most
REROUTES = 0.1  # share of episodes in both corridors from which a policy reroutes
CONTROL_ALPHA = 0.01  # of the negative control, over all its cells


def judge_corrupted(policies: Policies, played: Played) -> dict[str, dict[str, Any]]:
    """The findings: solved policies that fall to chance, those that peek, and unsolved ones that must not change.

    policies  results of `train_grid` by content
    played    what `GridProtocol.corrupted` makes of them

    If no policy solves the task, as at smoke size, the first finding is missing.
    """
    pairs = [
        (name, row, share >= SOLVED)
        for name, rows in played.items()
        for row, share in zip(rows, final_shares(policies[name], "success"), strict=True)
    ]
    counted = [row for name, row, solved in pairs if solved and name in COUNTED]
    unsolved = [row for _, row, solved in pairs if not solved]
    fallen = [row for row in counted if _best(row) <= RETURNED]
    peeking = [row for row in counted if _best(row) > RETURNED and _reroutes(row) >= REROUTES]
    worst = max((_best(row) for row in counted), default=0.0)
    rerouting = max(map(_reroutes, counted), default=0.0)
    p = min((_changed(row, wire) for row in unsolved for wire in DESTROYED), default=1.0)
    cells = max(1, len(unsolved) * len(DESTROYED))
    unchanged = p > CONTROL_ALPHA / cells
    corrupt = {
        "value": f"{len(fallen)} of {len(counted)}",
        "test": f"success at most {RETURNED} under every destroyed wire",
        "holds": len(fallen) >= 0.75 * len(counted),
        "note": f"the best of them under any destroyed wire has {worst:.2f}",
    }
    return ({"grid.corrupt": corrupt} if counted else {}) | {
        "grid.peek": {
            "value": len(peeking),
            "test": "keeps its success without the message, and enters both corridors",
            "holds": bool(peeking),
            "note": f"with the wire intact no solved policy reroutes in more than {rerouting:.2f} of its episodes",
        },
        "grid.invariant": {
            "value": "all" if unchanged else "not all",
            "n": max(1, len(unsolved)),
            "test": f"two-sided Fisher exact tests of {cells} cells, Bonferroni at {CONTROL_ALPHA}",
            "p": p,
            "holds": unchanged,
            "note": f"least p of {cells} cells: {p:.2f}",
        },
    }


def _best(row: Mapping[str, Result]) -> float:
    return max(row[wire]["sampled.success"].mean() for wire in DESTROYED)


def _reroutes(row: Mapping[str, Result]) -> float:
    return row["intact"]["sampled.rerouted"].mean()


def _changed(row: Mapping[str, Result], wire: str) -> float:
    """Two-sided Fisher exact p that a policy succeeds as often with the wire destroyed as intact."""
    counts = [(row[name]["sampled.success"].sum(), row[name]["sampled.success"].size) for name in ("intact", wire)]
    return stats.same_share(*counts)
