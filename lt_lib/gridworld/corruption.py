"""Tables, figures and judgements of the corruption controls in the gridworld (Section Corruption controls).

`policies` are results of `train_grid` by content, `played` what `GridProtocol.corrupted` makes of them.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lt_lib.comm.channel import CORRUPTIONS
from lt_lib.comm.messages import CONDITIONS
from lt_lib.pixels.figures import SOLVED, final_shares
from lt_lib.report import stats
from lt_lib.report.style import ROLES, chance_line
from lt_lib.store.run import Result

Policies = Mapping[str, Sequence[Result]]
Played = Mapping[str, Sequence[Mapping[str, Result]]]
DESTROYED = tuple(wire for wire in CORRUPTIONS if wire != "intact")
COUNTED = ("latent", "predicted", "raw")  # the paper's twelve: solved policies of these contents
RETURNED = 0.6  # success of a policy that corruption has returned to chance, at most
REROUTES = 0.1  # share of episodes in both corridors from which a policy reroutes
LEVEL = 0.01  # of the negative control, over all its cells


def dots(policies: Policies, played: Played) -> Figure:
    """Success and episode length by wire condition: a line a policy, solved ones in colour, the others grey."""
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    x, shift = np.arange(len(CORRUPTIONS)), np.random.default_rng(0)  # a sidestep keeps lines apart
    for name, rows in played.items():
        for row, share in zip(rows, final_shares(policies[name], "success"), strict=True):
            colour = ROLES[CONDITIONS[name].role] if share >= SOLVED else "0.7"
            places = x + shift.uniform(-0.12, 0.12)
            for axes, key in zip(panels, ("success", "length"), strict=True):
                values = [row[wire][f"sampled.{key}"].mean() for wire in CORRUPTIONS]
                axes.plot(places, values, "o-", color=colour, ms=4, lw=0.7, alpha=0.8)
    for role in ("ours", "diagnostic", "upper bound"):
        panels[0].plot([], [], "o", color=ROLES[role], label=f"solved: {_contents(role)}")
    panels[0].plot([], [], "o", color="0.7", label="never solved")
    chance_line(panels[0])
    panels[0].set(ylim=(-0.03, 1.05), ylabel="success")
    panels[0].legend(fontsize=8, ncols=2)
    panels[1].set(ylim=(0, 103), ylabel="episode length (steps)", xlabel="what happens to the wire at evaluation")
    panels[1].set_xticks(x, [wire.replace("_", " ") for wire in CORRUPTIONS])
    return figure


def _contents(role: str) -> str:
    return ", ".join(name for name in ("latent", "predicted", "oracle", "raw") if CONDITIONS[name].role == role)


def table(policies: Policies, played: Played) -> pd.DataFrame:
    """Mean success over seeds, sampled actions, the greedy mean in brackets; a row a content."""
    rows = {}
    for name, results in played.items():
        solved = int((final_shares(policies[name], "success") >= SOLVED).sum())
        row = {"solved": f"{solved} of {len(results)}"}
        for wire in CORRUPTIONS:
            sampled, greedy = (
                np.mean([result[wire][f"{choice}.success"].mean() for result in results])
                for choice in ("sampled", "greedy")
            )
            row[wire.replace("_", " ")] = f"{sampled:.2f} ({greedy:.2f})"
        rows[name] = row
    return pd.DataFrame(rows).T


def judge(policies: Policies, played: Played) -> dict[str, dict[str, Any]]:
    """The gridworld's findings: policies that fall, policies that peek, and those that must not change.

    Where no policy solved the task, as at smoke size, there is nothing to say of the first.
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
    unchanged = p > LEVEL / cells
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
            "test": f"two-sided Fisher exact tests of {cells} cells, Bonferroni at {LEVEL}",
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
