"""For every measured claim, a result that refutes it and one that supports it, given to the judge of its row."""

from functools import partial

import numpy as np
import pytest
from scipy.special import expit

from lt_lib.gridworld import judgements as grid
from lt_lib.hardware import judgements as hardware
from lt_lib.learnability import judgements as learnability
from lt_lib.pixels import judgements as pixels
from lt_lib.report import judges, stats
from lt_lib.report.claims import NOT_REPRODUCED, REPRODUCED, SAME_DIRECTION, Finding, Findings, load_claims, verdict
from lt_lib.report.perception import rank_falls
from lt_lib.settings.base import ROOT
from lt_lib.velocity import judgements as velocity
from lt_lib.velocity.coverage import STATED

# as if no row had been set aside: a calibrating row has a judge like any other
CLAIMS = {name: claim.model_copy(update={"calibrates": ""}) for name, claim in load_claims().items()}


def seeds(*shares: float, n: int = 500) -> np.ndarray:
    """(seeds, n) outcomes with these shares of ones, spread over the episodes."""
    return np.stack([np.random.default_rng(i).permutation(n) < round(share * n) for i, share in enumerate(shares)])


def real(*shares: float, n: int = 256) -> np.ndarray:
    """`seeds` as numbers."""
    return seeds(*shares, n=n).astype(float)


def one(share: float, n: int = 128) -> np.ndarray:
    return seeds(share, n=n)


def three(share: float, n: int = 128) -> np.ndarray:
    """Three navigators alike."""
    return seeds(share, share, share, n=n)


ONES, HALF = seeds(1, 1, 0.99, 1, 1), seeds(0.49, 0.5, 0.52, 0.47, 0.5)
THREE, HALVES = seeds(0.99, 1, 1), seeds(0.49, 0.5, 0.52)
MANY, MANY_HALF = seeds(*[0.995] * 12), seeds(*np.linspace(0.48, 0.52, 12))
# the point-mass study: 48 settings in z, five seeds each
Z = np.linspace(0.2, 18, 48)
WINDOW = np.tile([10, 30, 60], 16)


def learned(centre, width: float = 0.3) -> np.ndarray:
    """(48, 5) success of runs whose share solved falls around a centre."""
    rng = np.random.default_rng(0)
    return np.where(rng.random((48, 5)) < expit((np.reshape(centre, -1)[:, None] - Z[:, None]) / width), 1.0, 0.5)


def late(length: int, heads: int = 3) -> np.ndarray:
    return np.random.default_rng(0).normal(length, 20, (heads, 256))


def first_of(chooses: bool) -> tuple[np.ndarray, np.ndarray]:
    """First corridor and slab of two trainings: one that always takes the left, or one that takes the free one."""
    slab = np.tile([0, 1], (2, 64))
    return (1 - slab, slab) if chooses else (np.zeros_like(slab), slab)


def one_of(chooses: bool) -> tuple[np.ndarray, np.ndarray]:
    first, slab = first_of(chooses)
    return first[:1], slab[:1]


def scored(right: bool, wrong: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Scores of 51 hazard and 51 clear frames: those of a decode with so many errors of either kind, or of a coin."""
    hazard = np.ones(51) if right else np.tile([1.0, -1.0, -1.0], 17)
    hazard[:wrong] *= -1
    return hazard, (-hazard if right else hazard.copy())


def latents(rank: int) -> np.ndarray:
    """(60, 4, 64) latents that vary in so many dimensions."""
    out = np.zeros((60, 4, 64))
    out[..., :rank] = np.random.default_rng(rank).normal(size=(60, 4, rank))
    return out


chosen = {name: pixels.table_3(name)[0] for name in ("latent", "predicted", "oracle", "raw", "floor")}
at_floor = partial(judges.alike, of="the floor", margin=stats.AT_REFERENCE)
as_good = partial(judges.alike, of="the latent", margin=stats.AS_GOOD)
redrawn = pixels.lower_block("k1")[0]
guards = partial(rank_falls, of="prediction alone")
more = partial(judges.more, of="latent against raw")
words_above, words_below = (partial(each, of="others") for each in (judges.words_above, judges.words_below))
greedy = partial(judges.at_least, share=0.95)
decodes = partial(hardware.decodes, gate=0.75)
CELL = ((seeds(1, 1, 1, n=256), seeds(1, 0.9, 1, n=256)), (seeds(1, 1, 1, n=256), seeds(0.5, 0.48, 0.52, n=256)))
COIN = (CELL[0], (seeds(1, 1, 1, n=256), seeds(0.52, 0.5, 0.55, n=256)))
ORACLE = ((seeds(1, n=256), seeds(0.9, n=256)), (seeds(1, n=256), seeds(0.53, n=256)))
LOST = [real(1, 1, 1), *[real(0.5, 0.45, 0.1)] * 4]
KEPT = [real(1, 1, 1), *[real(0.95, 0.96, 0.97)] * 4]
SAME, CHANGED = np.zeros((5, 256)), np.tile([1.0, 0.0, 0.0, 0.0], (5, 64))
SWEEP_UP = [three(share) for share in (0, 0, 0.02, 0.05, 0.1, 0.2, 0.3)]
SWEEP_DOWN = [three(share) for share in (0.9, 0.85, 0.4, 0.3, 0.2, 0.1, 0.05)]
SWEEP_FLAT = [three(0.9)] * 7

# id: the judge of its row, samples that refute the claim, samples that support it
CASES = {
    "enc.guards": (guards, (latents(6), latents(6)), (latents(50), latents(6))),
    "grid.latent": (partial(judges.solves, of="the floor"), (HALF, HALF), (ONES, HALF)),
    "grid.predicted": (partial(judges.solves, of="the floor"), (HALF, HALF), (seeds(1, 1, 1, 1, 0.6), HALF)),
    "grid.raw": (
        partial(judges.solves_fewer, of="the latent"),
        (ONES, ONES),
        (seeds(0.95, 0.93, 0.94, 0.5, 0.5), seeds(*[1] * 5)),
    ),
    "grid.more_than_raw": (more, (ONES, ONES), (ONES, HALF)),
    "grid.reconstruction": (more, (ONES, ONES), (ONES, HALF)),
    "grid.zero_value": (more, (ONES, ONES), (ONES, HALF)),
    "grid.pixels": (words_above, (HALF, HALF), (ONES, HALF)),
    "grid.kinematic": (judges.solves_none, (seeds(*[0.5] * 14, 0.95),), (seeds(*[0.5] * 15),)),
    "grid.chance": (judges.at_chance, (seeds(*[0.35] * 15),), (seeds(*np.linspace(0.44, 0.5, 15)),)),
    "grid.corrupt": (grid.returned, KEPT, [real(*[1] * 12), *[real(*[0.4] * 10, 0.9, 0.9)] * 4]),
    "grid.peek": (
        grid.peeking,
        (real(0, 0, 0), *LOST[1:]),
        (real(0.3, 0.3, 0), real(0.9, 0.8, 0.2)),
    ),
    "grid.peek_length": (grid.longer_episodes, (late(40), late(60)), (late(80, 4), late(40, 4))),
    "grid.invariant": (grid.unchanged, (SAME, CHANGED), (SAME, SAME)),
    "px.obedience": (partial(judges.at_least, share=0.99), (one(0.98, 5000),), (one(0.9996, 5000),)),
    "px.latent.route": (chosen["latent"], (HALF, HALF), (ONES, HALF)),
    "px.predicted.route": (chosen["predicted"], (HALVES, HALF), (THREE, HALF)),
    "px.oracle.route": (chosen["oracle"], (HALF, HALF), (ONES, HALF)),
    "px.raw.route": (chosen["raw"], (THREE, ONES), (seeds(0.95, 0.96, 0.55), seeds(1, 1, 1, 1, 1))),
    **{
        f"px.{name}.route": (chosen["floor"], (seeds(0.62, 0.6, 0.61),), (seeds(0.49, 0.5, 0.48),))
        for name in ("floor", "zerowire", "position", "trajectory")
    },
    "px.k30.route": (redrawn, (ONES, ONES), (seeds(0.92, 0.93, 0.9, 0.91, 0.94), ONES)),
    "px.k1.route": (redrawn, (ONES, ONES), (seeds(0.78, 0.8, 0.7, 0.75, 0.81), ONES)),
    "px.oracle_k1.route": (redrawn, (ONES, ONES), (seeds(0.92, 0.93, 0.9, 0.91, 0.94), ONES)),
    "px.redraw_order": (
        judges.falls,
        (ONES, ONES, HALF),
        (ONES, seeds(0.92, 0.93, 0.9, 0.91, 0.94), seeds(0.78, 0.8, 0.7, 0.75, 0.81)),
    ),
    "px.greedy": (greedy, (seeds(1, 0.9),), (seeds(1, 0.998),)),
    "px.raw_collapse": (
        pixels.entropy_collapse,
        (np.array([1e-3, 1e-2, 0.3]), np.array([0.5, 0.95, 0.95])),
        (np.array([1e-6, 1e-2, 0.3]), np.array([0.5, 0.95, 0.95])),
    ),
    "px.matches_oracle": (as_good, (MANY, seeds(*[0.96] * 12)), (MANY, MANY)),
    "px.predicted_alike": (as_good, (MANY, seeds(*[0.96] * 12)), (MANY, MANY)),
    "px.kinematic_floor": (at_floor, (MANY_HALF, MANY_HALF, MANY_HALF * 0.8), (MANY_HALF, MANY_HALF, MANY_HALF)),
    "px.anchor_silent": (at_floor, (MANY_HALF, seeds(*[0.56] * 12)), (MANY_HALF, MANY_HALF)),
    "px.raw_unreliable": (more, (MANY, MANY), (MANY, seeds(*[0.95] * 5, *[0.5] * 7))),
    "px.anchor_needed": (words_below, (ONES, ONES), (HALF, ONES)),
    "px.both_routes": (
        partial(pixels.both_routes, batch=256),
        (seeds(0.9, 0.5, 0.5, 0.5, 0.5, n=256),),
        (seeds(0.49, 0.5, 0.52, 0.48, 0.5, n=256),),
    ),
    **{f"px.{name}.sd": None for name in ("latent", "predicted", "oracle", "raw", "floor", "zerowire", "position")},
    **{f"px.{name}.sd": None for name in ("trajectory", "k30", "k1", "oracle_k1")},
    **{f"cor.{wire}.latent": (pixels.destroyed, *CELL) for wire in ("content", "wire", "shuffle", "noise")},
    **{f"cor.{wire}.oracle": (pixels.destroyed, *ORACLE) for wire in ("content", "wire", "shuffle", "noise")},
    "cor.constant": (pixels.one_corridor, (seeds(0.9, 1),), (seeds(1, 0),)),
    "cor.length_zeroed": (pixels.longer, (late(209), late(230)), (late(209), np.vstack([late(380, 2), late(440, 1)]))),
    "cor.span": (partial(judges.within, low=0.41, high=0.56), (seeds(0.5, 0.9, n=256),), (seeds(0.45, 0.55, n=256),)),
    "port.null": (velocity.all_committed, first_of(True), first_of(False)),
    "port.null_oracle": (velocity.range_committed, first_of(True), first_of(False)),
    "port.null_silent": (velocity.one_committed, one_of(True), one_of(False)),
    "port.probe": (velocity.probe_recovers, (one(0.9),), (one(1.0),)),
    "port.held": (
        partial(velocity.held_near, d=0.83),
        (np.full((3, 64), 0.2),),
        (np.linspace(0.75, 0.9, 3 * 64).reshape(64, 3).T,),
    ),
    "port.remedy": (words_above, (HALF, HALF), (ONES, HALF)),
    **{
        name: (
            partial(velocity.sweep_row, side=side, coverage=coverage, competent=competent),
            # the paper's opposite: no coverage where it reaches, success where it collapses
            (three(0.0 if side == "above" else 0.4), three(0.0 if competent else 1.0)),
            (three(CLAIMS[name].paper[0]), three(CLAIMS[name].paper[1])),
        )
        for name, (side, coverage, competent) in STATED.items()
    },
    "cov.opposition": (velocity.opposed, (*SWEEP_UP, *[three(1.0)] * 7), (*SWEEP_UP, *SWEEP_DOWN)),
    "cov.collapse_first": (velocity.only_where_collapsed, (*SWEEP_UP, *SWEEP_FLAT), (*SWEEP_UP, *SWEEP_DOWN)),
    "cov.reaches": (velocity.noise_reaches, (three(0.03),), (three(0.22),)),
    "cov.destroys": (velocity.competence_destroyed, (three(0.95), three(0.91)), (three(0.68), three(0.1))),
    "cov.bit_shift": (velocity.shifted, (np.array([2.0, 0.2]),), (np.array([2.6, 2.8]),)),
    "cov.bit_route": (greedy, (seeds(1, 0.9),), (seeds(1, 1),)),
    "cov.bit_success": (velocity.flip_costs, (one(0.8), one(0.8)), (one(1.0), one(0.41))),
    "cov.boost_early": (velocity.boost_opens, (three(0.0), three(0.01)), (three(0.19), three(0.26))),
    "cov.boost_late": (
        partial(velocity.boost_fades, early=1),
        (three(0.2), three(0.2)),
        (three(0.2), three(0.0), three(0.05)),
    ),
    "z.center": (partial(learnability.centre, z=Z, paper=4.2), (learned(9.0),), (learned(4.2),)),
    "z.collapse": (
        partial(learnability.collapse, z=Z, window=WINDOW),
        (learned(np.where(WINDOW == 10, 2.0, np.where(WINDOW == 30, 6.0, 10.0))),),
        (learned(4.2),),
    ),
    "z.ceiling": (
        partial(learnability.ceiling, paper=138),
        (learned(1.0),),
        (np.repeat([1.0, 0.5], [138, 102]).reshape(48, 5),),
    ),
    "z.between": (learnability.between, (np.repeat([1.0, 0.7, 0.5], [100, 20, 120]).reshape(48, 5),), (learned(4.2),)),
    "z.separation": (
        learnability.separated,
        (np.array([1.0, 0.5, 1.0]), np.array([0.5, 0.1, 0.5]), np.array([0.1, 0.2, 0.5])),
        (np.array([1.0, 0.5, 1.0]), np.array([0.5, 0.1, 0.5]), np.array([0.3, 0.2, 0.5])),
    ),
    "z.categorical": (learnability.every_setting, (learned(10.0),), (np.ones((48, 5)),)),
    "z.no_signal": (
        partial(learnability.control, episodes=32768),
        (np.append(np.full(239, 0.5), 0.6),),
        (np.append(np.full(239, 0.5), 0.508),),
    ),
    "z.sgd_edge": (
        partial(learnability.edges, z=Z),
        (learned(4.0), learned(4.0)),
        (learned(3.1, 0.01), learned(5.8, 0.01)),
    ),
    "z.sgd_fast": (
        partial(learnability.fast_edge, z=Z),
        (learned(5.8, 0.01), learned(5.8, 0.01)),
        (learned(3.1, 0.01), learned(5.8, 0.01)),
    ),
    "z.falls": (partial(learnability.falls_to_zero, z=Z), (learned(30.0),), (learned(5.0),)),
    "z.walk": (
        partial(learnability.softened, z=Z),
        (learned(4.0, 0.02), learned(4.0, 0.02)),
        (learned(5.0, 2.0), learned(4.0, 0.02)),
    ),
    "z.score": (
        partial(learnability.inverse_score, sigmas=np.array([0.5, 1.0, 2.0])),
        (np.random.default_rng(0).normal(size=(3, 4000)),),
        (np.random.default_rng(0).normal(size=(1, 4000)) / np.array([[0.5], [1.0], [2.0]]),),
    ),
    "hw.auc": (hardware.direction, scored(False), scored(True, 1)),
    "hw.operating_point": (hardware.threshold_lost, scored(True), (np.ones(51), np.ones(51))),
    "hw.validation": (decodes, scored(False), scored(True, 4)),
    "hw.decisions": (partial(hardware.decisions, gate=0.95), scored(False), scored(True)),
    "hw.red_rule": (partial(hardware.decodes, gate=0.95), scored(False), scored(True)),
    "hw.bang_bang": (hardware.bang_bang, (np.full((2, 3), 0.3),), (np.array([[0.84, 0.9, 0.97]] * 2),)),
    "hw.appearance": (
        hardware.drops_appearance,
        (np.array([0.9, 0.8, 0.9, 0.8]), np.array([0.95, 0.96, 0.97, 0.98])),
        (np.array([0.1, 0.05, 0.1, 0.0]), np.array([0.95, 0.96, 0.97, 0.98])),
    ),
}  # fmt: skip
# rows that a notebook compares in the open, without a judge: a plain equality, or a count
IN_THE_OPEN = {
    "px.no_more_compute", "port.message", "port.controller", "hw.refit_frames", "hw.placements",
    *(f"cor.{wire}.range" for wire in ("content", "wire", "shuffle", "noise")),
}  # fmt: skip


def _spread_case(name: str):
    claim = CLAIMS[name]
    shares = claim.paper * np.array([-1.0, 1.0, 0.0, 1.0, -1.0])[: claim.n]
    exact = shares / shares.std(ddof=1) * claim.paper
    return partial(judges.spread, sd=claim.paper, n=claim.n), (exact * 30,), (exact,)


CASES = {name: case or _spread_case(name) for name, case in CASES.items()}


def judged(name: str, samples) -> str:
    entry = dict(CASES[name][0](*samples))
    findings = Findings(CLAIMS[name].nb, ROOT, "full", CLAIMS)
    findings.add(name, **entry, real_frames=True)
    return verdict(CLAIMS[name], findings.found[name], "full")


def test_every_measured_claim_has_its_counterexample():
    measured = {name for name, claim in CLAIMS.items() if claim.tested and not claim.follows}
    assert measured == CASES.keys() | IN_THE_OPEN


@pytest.mark.parametrize("name", CASES)
def test_a_result_that_refutes_a_claim_reads_not_reproduced_and_one_that_supports_it_does_not(name):
    _, against, for_it = CASES[name]
    assert judged(name, against) == NOT_REPRODUCED
    assert judged(name, for_it) == REPRODUCED


@pytest.mark.parametrize("name", sorted(IN_THE_OPEN))
def test_a_row_compared_in_the_open_reads_not_reproduced_where_its_comparison_fails(name):
    claim = CLAIMS[name]
    value = "no" if isinstance(claim.paper, str) else claim.paper
    assert verdict(claim, Finding(value=value, holds=False, real_frames=True), "full") == NOT_REPRODUCED


def test_a_number_outside_its_margin_whose_test_holds_goes_in_the_same_direction():
    assert judged("px.k1.route", (seeds(0.95, 0.96, 0.94, 0.95, 0.96), seeds(1, 1, 1, 1, 1))) == SAME_DIRECTION
