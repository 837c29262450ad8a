"""Figures and tables of the hardware decode: what the camera does to a frame, and what the decode makes of it."""

from collections.abc import Mapping, Sequence
from itertools import zip_longest

import numpy as np
import pandas as pd
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lt_lib.hardware.matched import PictureEncoder
from lt_lib.hardware.probe import Transfer, decoded, fit_probe, frechet, placements_right, red_shares
from lt_lib.hardware.sessions import EFFECTS, Session
from lt_lib.report import stats
from lt_lib.report.style import ROLES, chance_line
from lt_lib.store.run import Result

HAZARD, CLEAR = "#B22222", ROLES["ours"]
CAMERA = ("refit", "validation", "live")
ACROSS = 10  # pictures in a row


def rows_of_pictures(rows: Mapping[str, UInt8[np.ndarray, "n h w 3"]]) -> Figure:
    """One row of pictures a name, as many as there are."""
    columns = max(len(pictures) for pictures in rows.values())
    shape = next(iter(rows.values())).shape
    figure = Figure(figsize=(1.25 * columns * shape[2] / shape[1] + 1.3, 1.3 * len(rows) + 0.4), layout="constrained")
    panels = figure.subplots(len(rows), columns, squeeze=False)
    for line, (name, pictures) in zip(panels, rows.items(), strict=True):
        for axes, picture in zip_longest(line, pictures):
            axes.set(xticks=[], yticks=[], frame_on=picture is not None)
            if picture is not None:
                axes.imshow(picture, interpolation="nearest")  # pixels as the encoder gets them
        line[0].set_ylabel(name, fontsize=8)
    return figure


def some(session: Session, dim: bool | None = None, n: int = ACROSS) -> UInt8[np.ndarray, "n 64 64 3"]:
    """Frames of as many placements, hazard first; only one lighting state unless it is None."""
    kept = np.ones(len(session.hazard), bool) if dim is None else session.dim == dim
    _, first = np.unique(session.placement[kept], return_index=True)
    which = np.flatnonzero(kept)[np.sort(first)]
    hazard, clear = which[session.hazard[which]][: n - n // 2], which[~session.hazard[which]][: n // 2]
    return session.frames[np.concatenate([hazard, clear])]


def shift_table(transfers: Mapping[str, Transfer], simulated_again: Mapping[str, Float[np.ndarray, "n d"]]):
    """Frechet distance of latents from the simulated bench, a row an encoder; the first column is what chance gives."""
    table = {}
    for name, each in transfers.items():
        reference, n = each.latents["simulated"], len(each.latents["live"])
        row = {f"simulation again, {n} frames": frechet(simulated_again[name][:n], reference)}
        table[name] = row | {session: frechet(each.latents[session], reference) for session in CAMERA}
    return pd.DataFrame(table).T.round(1)


def colour_table(sessions: Mapping[str, Session], red_ratio: float) -> pd.DataFrame:
    """Mean ± standard deviation of red, green and blue, and the share of red pixels, by session and answer."""
    rows = {}
    for name, session in sessions.items():
        for answer, which in (("hazard", session.hazard), ("clear", ~session.hazard)):
            pixels = session.frames[which].reshape(-1, 3).astype(float)
            levels = {c: f"{m:.0f} ± {s:.0f}" for c, m, s in zip("RGB", pixels.mean(0), pixels.std(0), strict=True)}
            rows[f"{name}, {answer}"] = levels | {
                "red pixels": f"{red_shares(session.frames[which], red_ratio).mean():.2f}"
            }
    return pd.DataFrame(rows).T


def decode_table(transfers: Mapping[str, Transfer]) -> pd.DataFrame:
    """AUC and balanced accuracy of both probes on every session, an encoder a pair of rows."""
    rows = {}
    for name, each in transfers.items():
        for words, probe in (("fitted in simulation", each.simulated), ("refit", each.refit)):
            row = {}
            for session in each.latents:
                row |= {(session, key): value for key, value in each.decoded(probe, session)._asdict().items()}
            rows[(name, words)] = row
    return pd.DataFrame(rows).T.round(3)


def fallback(transfer: Transfer, gate: float) -> str:
    """What the registered rule says of the probe fitted in simulation, judged on the refit session."""
    first = transfer.decoded(transfer.simulated, "refit").balanced
    if first < gate:
        return f"the registered fallback applies: {first:.3f} on the refit session misses the gate of {gate}"
    live = transfer.decoded(transfer.simulated, "live").balanced
    return (
        f"the registered rule would have kept the probe fitted in simulation ({first:.3f} on the refit session), "
        f"whose live balanced accuracy is {live:.3f}; the value is the refit probe's where there is one"
    )


def scores(transfer: Transfer, sessions: Mapping[str, Session], rng: np.random.Generator) -> Figure:
    """Both probes' scores of every camera decision; the threshold is the dotted line at 0."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, probe, words in (
        (panels[0], transfer.simulated, "probe fitted in simulation"),
        (panels[1], transfer.refit, "probe refit on the refit session"),
    ):
        for x, name in enumerate(("simulated", *CAMERA)):
            values, hazard = probe.scores(transfer.latents[name])[:400], transfer.hazard[name][:400]
            for answer, colour, shift in ((True, HAZARD, -0.16), (False, CLEAR, 0.16)):
                at = x + shift + rng.uniform(-0.1, 0.1, (hazard == answer).sum())
                axes.plot(at, values[hazard == answer], "o", ms=3, color=colour, alpha=0.6, mew=0)
        axes.axhline(0, color="black", ls=":", lw=1.2)
        axes.set_xticks(range(4), ["simulated", *(f"{n}\n{len(sessions[n].hazard)} frames" for n in CAMERA)])
        axes.set(title=words, ylabel="score: above the dotted threshold says 'hazard'")
    panels[0].plot([], [], "o", color=HAZARD, label="hazard")
    panels[0].plot([], [], "o", color=CLEAR, label="clear")
    panels[0].legend(fontsize=8)
    return figure


def spread(seeds: Mapping[str, Sequence[float]], selected: Mapping[str, float], plain: Mapping[str, float]) -> Figure:
    """Balanced accuracy of the refit probe by session: a dot an encoder seed, marks the two larger encoders."""
    figure = Figure(figsize=(9.5, 3.8), layout="constrained")
    axes = figure.subplots()
    for x, (name, values) in enumerate(seeds.items()):
        low, high = stats.mean_interval(values)
        mean = np.mean(values)
        axes.plot(x + np.linspace(-0.2, 0.2, len(values)), values, "o", color="0.55", ms=5, mew=0, alpha=0.8)
        axes.errorbar(x + 0.3, mean, [[mean - low], [high - mean]], fmt="s", color="black", capsize=3, ms=5,
                      label=None if x else "mean of the seeds, 95% t interval")  # fmt: skip
        axes.plot(x - 0.3, selected[name], "D", color=ROLES["ours"], ms=8, label=None if x else "selected encoder")
        axes.plot(x - 0.3, plain[name], "X", color=ROLES["upper bound"], ms=8,
                  label=None if x else "its twin without randomisation")  # fmt: skip
    axes.plot([], [], "o", color="0.55", label="an encoder seed of the cheaper size")
    chance_line(axes)
    axes.set_xticks(range(len(seeds)), list(seeds))
    axes.set(ylim=(0.4, 1.03), ylabel="balanced accuracy\nof the refit probe")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure


def what_breaks(
    curves: Mapping[str, Mapping[str, np.ndarray]], seeds: Mapping[str, np.ndarray], nominal: Mapping[str, float]
) -> Figure:
    """Balanced accuracy against the strength of each effect; the triangle is the strength that the sessions have.

    curves  by effect and encoder, (S,) one a strength;  seeds  by effect, (N, S), one row an encoder seed
    """
    columns = min(5, len(curves))
    lines = -(-len(curves) // columns)
    figure = Figure(figsize=(3.0 * columns + 0.5, 2.7 * lines + 0.5), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False, sharey=True).ravel()
    styles = {"with randomisation": (ROLES["ours"], "-", "o"), "without": (ROLES["upper bound"], "--", "s")}
    for axes, (effect, encoders) in zip(panels, curves.items(), strict=False):
        strengths = EFFECTS[effect].strengths
        at = np.arange(len(strengths))
        for values in seeds[effect]:
            axes.plot(at, values, color="0.6", lw=0.7, alpha=0.7)
        for name, values in encoders.items():
            colour, line, marker = styles[name]
            axes.plot(at, values, line, marker=marker, ms=4, color=colour, lw=1.6)
        axes.plot(strengths.index(nominal[effect]), 0.42, "^", color="black", ms=6, clip_on=False)
        chance_line(axes)
        axes.set_xticks(at, [f"{strength:g}" for strength in strengths], fontsize=8)
        axes.set_xlabel(EFFECTS[effect].unit, fontsize=8)
        axes.set_ylim(0.4, 1.03)
    for axes in panels[len(curves) :]:
        axes.set_axis_off()
    handles = [
        Line2D([], [], color=colour, ls=line, marker=marker, label=name)
        for name, (colour, line, marker) in styles.items()
    ]
    handles += [Line2D([], [], color="0.6", label="encoder seeds of the cheaper size, with randomisation")]
    handles += [Line2D([], [], color="black", marker="^", ls="", label="strength in the sessions")]
    figure.legend(handles=handles, loc="outside upper center", ncols=4, fontsize=8)
    figure.supylabel("balanced accuracy of the refit probe")
    return figure


def under_effects(encoder: Result, refit: Session, sweeps: Mapping[str, Result]) -> dict[str, Float[np.ndarray, " s"]]:
    """Balanced accuracy at each strength of each effect, of the probe fitted to a refit session."""
    network = PictureEncoder(encoder)
    probe = fit_probe(network.latents(refit.frames), refit.hazard)

    def accuracy(frames, hazard) -> float:
        return decoded(probe.scores(network.latents(frames)), hazard).balanced

    return {
        effect: np.array([accuracy(frames, sweep["hazard"]) for frames in sweep["frames"]])
        for effect, sweep in sweeps.items()
    }


def break_table(
    pair: Mapping[str, Mapping[str, np.ndarray]], many: Mapping[str, np.ndarray], gate: float
) -> pd.DataFrame:
    """Balanced accuracy at the greatest strength of each effect, an effect a row; arguments as for `what_breaks`."""
    rows = {}
    for effect, encoders in pair.items():
        worst = {name: f"{values[-1]:.2f}" for name, values in encoders.items()}
        seeds = many[effect][:, -1]
        worst |= {"encoder seeds, mean": f"{seeds.mean():.2f}", "worst seed": f"{seeds.min():.2f}"}
        greatest = f"{EFFECTS[effect].unit}: {EFFECTS[effect].strengths[-1]:g}"
        rows[greatest] = worst | {f"seeds at {gate} or above": f"{(seeds >= gate).sum()} of {len(seeds)}"}
    return pd.DataFrame(rows).T


def live_table(session: Session, right: np.ndarray) -> pd.DataFrame:
    """Decisions right, by answer and lighting."""
    rows = {}
    for words, which in (
        ("hazard", session.hazard), ("clear", ~session.hazard), ("bright", ~session.dim), ("dim", session.dim),
        ("nearer than 185 cm", session.distance < 185), ("185 cm or farther", session.distance >= 185),
        ("all", np.ones(len(right), bool)),
    ):  # fmt: skip
        if which.any():
            low, high = stats.wilson(int(right[which].sum()), int(which.sum()))
            whole, placements = placements_right(right[which], session.placement[which])
            rows[words] = {
                "decisions right": f"{right[which].sum()} of {which.sum()}",
                "95% Wilson": f"{low:.3f} to {high:.3f}",
                "placements wholly right": f"{whole} of {placements}",
            }
    return pd.DataFrame(rows).T


def red_rule(session: Session, ratio: float, share: float) -> tuple[float, float]:
    """AUC and balanced accuracy of the raw-pixel rule: a frame shows the hazard if so large a share of it is red."""
    return decoded(red_shares(session.frames, ratio) - share, session.hazard)
