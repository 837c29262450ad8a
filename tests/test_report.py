"""Statistics against closed forms, loops and the paper; claims, verdicts and the scoreboard on made-up results."""

import contextlib
import csv
import io
import itertools
import json
import math
import re
from fnmatch import fnmatch
from functools import partial

import numpy as np
import pytest
from scipy import stats as scipy_stats
from statsmodels.stats.weightstats import ttost_ind

from lt_lib.report import forest, judges, scoreboard, stats
from lt_lib.report.claims import Claim, Finding, Findings, load_claims, verdict
from lt_lib.report.entries import read_entries
from lt_lib.report.firmness import FRAGILE, firmness
from lt_lib.report.front import NUMBER, TEMPLATES, filled
from lt_lib.report.predictions import PREDICTIONS, Prediction
from lt_lib.settings.base import ROOT, UserError

EXACT = 1e-12  # closed forms and loops against floating point
PRINTED = 5e-5  # four printed decimals
FLOOR = [0.472, 0.496, 0.5, 0.49, 0.522]

# ---------------------------------------------------------------- statistics


def test_mean_interval_is_student_t():
    seeds = [0.90, 0.94, 0.95]  # mean 0.93, sd 0.02646; t(0.975, 2) = 4.30265
    low, high = stats.mean_interval(seeds)
    half = 4.30265273 * math.sqrt(0.0007 / 3)
    assert (low, high) == pytest.approx((0.93 - half, 0.93 + half), abs=1e-8)


def test_mean_interval_is_clipped_to_proportions():
    assert stats.mean_interval(np.array([0.98, 1.0, 1.0]))[1] == 1.0
    assert stats.mean_interval([0.0, 0.0, 0.02])[0] == 0.0


def test_mean_interval_of_one_seed_is_everything():
    assert stats.mean_interval([0.7]) == (0.0, 1.0)


def test_an_interval_of_equal_seeds_is_that_of_their_episodes_and_of_scattered_ones_that_of_the_seeds():
    assert stats.interval(np.ones((5, 500))) == stats.wilson(2500, 2500)
    scattered = np.repeat([[1.0], [0.5], [0.9]], 500, axis=1)
    assert stats.interval(scattered) == pytest.approx(stats.mean_interval([1.0, 0.5, 0.9]), abs=EXACT)
    assert stats.interval(np.ones((1, 128))) == stats.wilson(128, 128)


@pytest.mark.parametrize("successes, n", [(0, 0), (3, 2), (-1, 4)])
def test_wilson_refuses_what_is_no_count(successes, n):
    with pytest.raises(ValueError, match="wilson"):
        stats.wilson(successes, n)


def test_rank_test_refuses_a_nan_instead_of_a_p_of_zero():
    with pytest.raises(ValueError, match="finite"):
        stats.rank_test([0.5, math.nan], [0.5, 0.6])


@pytest.mark.parametrize("seeds", [[], [0.5, 1.2], [-0.1], [0.5, math.nan]])
def test_mean_interval_refuses_what_is_no_proportion(seeds):
    with pytest.raises(ValueError, match="proportions"):
        stats.mean_interval(seeds)


def test_wilson_gives_the_papers_bounds():
    assert stats.wilson(102, 102)[0] == pytest.approx(0.9637, abs=PRINTED)
    z2 = scipy_stats.norm.ppf(0.975) ** 2
    assert stats.wilson(34, 34) == pytest.approx((34 / (34 + z2), 1.0), abs=EXACT)
    assert stats.wilson(np.int64(0), np.int64(10)) == pytest.approx((0.0, z2 / (10 + z2)), abs=EXACT)


def test_rank_test_without_overlap_is_the_least_attainable():
    assert stats.rank_test([0.99, 1.0, 1.0, 1.0, 1.0], FLOOR) == pytest.approx(1 / 252, abs=EXACT)
    assert stats.rank_test(np.array([1.0]), np.array([0.5])) == 0.5


@pytest.mark.parametrize(
    "greater, less",
    [
        ([1.0, 1.0, 1.0, 0.5, 1.0], [1.0, 0.5, 0.5, 0.6, 1.0]),
        ([1.0, 1.0, 0.49], [1.0, 0.5, 0.52, 1.0]),
        (FLOOR, [0.5, 0.5, 0.49]),
        ([0.5, 0.5], [0.5, 0.5, 0.5]),
    ],
)
def test_rank_test_with_ties_equals_a_literal_loop(greater, less):
    pooled, size = [*greater, *less], len(greater)

    def wins(chosen):
        rest = [j for j in range(len(pooled)) if j not in chosen]
        return sum((pooled[i] > pooled[j]) + (pooled[i] == pooled[j]) / 2 for i in chosen for j in rest)

    everyone = [wins(chosen) for chosen in itertools.combinations(range(len(pooled)), size)]
    expected = sum(each >= wins(range(size)) for each in everyone) / len(everyone)
    assert stats.rank_test(greater, less) == pytest.approx(expected, abs=EXACT)


def test_rank_test_without_ties_equals_scipy():
    rng = np.random.default_rng(0)
    for sizes in ((6, 5), (25, 30)):
        greater, less = rng.normal(0.5, 1, sizes[0]), rng.normal(0, 1, sizes[1])
        expected = scipy_stats.mannwhitneyu(greater, less, alternative="greater", method="exact").pvalue
        assert stats.rank_test(greater, less) == pytest.approx(expected, abs=EXACT)


@pytest.mark.parametrize("greater, less", [([], [0.5]), ([0.5], [])])
def test_rank_test_refuses_an_empty_sample(greater, less):
    with pytest.raises(ValueError, match="two samples"):
        stats.rank_test(greater, less)


def outcomes(*shares: float, n: int = 500) -> np.ndarray:
    return np.stack([np.arange(n) < round(share * n) for share in shares]).astype(float)


@pytest.mark.parametrize("seeds", [[0.41, 0.45, 0.52], [0.7, 0.8, 0.75], [0.5, 0.3, 0.62, 0.55]])
def test_equivalence_with_a_number_is_the_worse_of_two_t_tests(seeds):
    above = scipy_stats.ttest_1samp(seeds, 0.4, alternative="greater").pvalue
    below = scipy_stats.ttest_1samp(seeds, 0.6, alternative="less").pvalue
    assert stats.equivalence(outcomes(*seeds), 0.5, 0.1) == pytest.approx(max(above, below), abs=EXACT)


def test_equivalence_of_two_samples_is_welch_s_by_statsmodels():
    one, other = [0.41, 0.52, 0.47, 0.55], [0.5, 0.44, 0.6]
    expected = ttost_ind(one, other, -0.1, 0.1, usevar="unequal")[0]
    assert stats.equivalence(outcomes(*one), outcomes(*other), 0.1) == pytest.approx(expected, abs=EXACT)


def test_equal_seeds_are_as_uncertain_as_their_episodes():
    assert 0 < stats.equivalence(outcomes(0.5, 0.5, 0.5), 0.5, 0.1) < 0.05
    assert stats.equivalence(outcomes(0.5, 0.5, n=10), 0.5, 0.1) > 0.05
    assert stats.equivalence(outcomes(0.6, 0.6), 0.5, 0.1) == pytest.approx(0.5)  # on the margin
    assert stats.equivalence(outcomes(0.75, 0.75), 0.5, 0.1) > 0.9
    assert stats.equivalence(outcomes(0.5), 0.5, 0.1) == 1.0


def test_paired_tests_count_the_pairs_that_disagree():
    one, other = np.array([1, 1, 1, 1, 0, 0]), np.array([0, 0, 0, 1, 0, 1])
    assert stats.paired_change(one, other) == pytest.approx(scipy_stats.binomtest(1, 4).pvalue)
    assert stats.paired_drop(one, other) == pytest.approx(scipy_stats.binomtest(1, 4, alternative="less").pvalue)
    assert stats.paired_drop(one, one) == 1.0


def test_a_verdict_is_firm_where_every_resample_gives_it_and_fragile_where_a_coin_decides():
    rng, above = np.random.default_rng(0), partial(judges.above, of="the floor")
    holds = lambda *samples: above(*samples)["holds"]
    assert firmness(holds, [outcomes(*[1.0] * 5), outcomes(*FLOOR)], rng) == 1.0
    edge = outcomes(0.52, 0.55, 0.53, 0.5, 0.54)
    assert 0.2 < firmness(holds, [edge, outcomes(*FLOOR)], rng) < FRAGILE


def test_paired_samples_are_resampled_alike_and_a_fixed_design_keeps_its_rows():
    rng, same = np.random.default_rng(0), np.arange(20.0).reshape(4, 5)
    assert firmness(lambda a, b: bool((a == b).all()), [same, same], rng, paired=True) == 1.0
    assert firmness(lambda a, b: bool((a == b).all()), [same, same], rng) < 1.0
    rows = np.repeat([[0.0], [1.0]], 50, axis=1)
    assert firmness(lambda a: tuple(a.mean(axis=1)), [rows], rng, fixed=True) == 1.0


def test_drop_test_is_the_hypergeometric_tail():
    intact, corrupted, n = 9, 4, 10
    total = intact + corrupted
    ways = sum(math.comb(n, k) * math.comb(n, total - k) for k in range(intact, min(n, total) + 1))
    expected = ways / math.comb(2 * n, total)
    assert stats.drop_test(np.int64(intact), corrupted, n) == pytest.approx(expected, abs=EXACT)
    assert stats.drop_test(4, 9, 10) > 0.9


# ---------------------------------------------------------------- claims

GOOD = "- {id: a, nb: 02_encoder, kind: measured, paper: 0.9, what: w, refuted: r, margin: 0.05}\n"


def test_the_papers_claims_are_all_there():
    claims = load_claims()
    kinds = [claim.kind for claim in claims.values()]
    assert list(claims)[:146][0::145] == ["occ.frame_pixels", "hw.bang_bang"]  # the paper's numbers, then its words
    assert {kind: kinds.count(kind) for kind in kinds} == {
        "exact": 23, "scene": 6, "config": 26, "measured": 131, "hardware": 7, "ours": 3,
    }  # fmt: skip
    assert claims["px.latent.route"].paper == 0.997
    assert claims["px.redraw_order"].what.endswith("(k = 0, 30, 1)")  # commas inside a text survive
    assert all(each.follows in claims for each in claims.values() if each.follows)


def test_paper_meets_every_criterion_of_its_own():
    unmet = {"occ.scout", "enc.probe_majority"}  # geometry that the paper does not print, and ours must not copy
    for claim in load_claims().values():
        finding = Finding(value=claim.paper, holds=True, real_frames=True)
        kind = "gate" if claim.gate else "context" if claim.kind in ("scene", "ours") else "reproduced"
        kind = "calibrated" if claim.calibrates else kind
        assert claim.id in unmet or verdict(claim, finding, "full") == kind, claim.id


@pytest.mark.parametrize(
    "text, complaint",
    [
        (GOOD.replace("margin", "margn"), "a.margn: unknown parameter"),
        (GOOD + GOOD, "a appears twice"),
        (GOOD.replace("02_encoder", "02_decoder"), "a.nb: must be '01_occlusion_check'"),
        (GOOD.replace("paper: 0.9, ", ""), "a.paper: Field required"),
        (GOOD.replace("0.05", "3e-4x"), "a.margin"),
        (GOOD.replace("0.05", "0.05, at_least: 1"), "a: kind measured allows at most one of"),
        (GOOD.replace("margin: 0.05", "digits: 2"), "a: kind measured allows at most one of"),
        (GOOD.replace(", margin: 0.05", ""), "a: no criterion for reproduction"),
        (GOOD.replace("refuted: r, ", ""), "a: a measured claim says what would refute it"),
        (GOOD.replace("0.05", "[0.05, 0.1]"), "a: expected one margin for each of 0.9"),
        (GOOD.replace("measured", "config"), "a: kind config allows at most one of"),
        (GOOD.replace("margin: 0.05", "margin: 0.05, calibrates: a.b"), "a: calibrates: stands in inferred.yaml alone"),
        ("a: 1\n", "expected a list of entries"),
        ("- [\n", "not valid YAML"),
        (None, "cannot be read"),
    ],
)
def test_bad_claims_are_one_clear_line(tmp_path, text, complaint):
    path = tmp_path / "claims.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UserError) as caught:
        load_claims(path)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


def claim(kind="measured", paper=0.9, **fields):
    return Claim(id="a", nb="04_pixels", what="w", kind=kind, paper=paper, **{"refuted": "r"} | fields)


REPRODUCED, SAME, NOT = "reproduced", "same direction", "not reproduced"
CONTEXT, GATE = "context", "gate"


@pytest.mark.parametrize(
    "judged, value, holds, expected",
    [
        (claim("exact", 0.90, digits=2), 0.8985, None, REPRODUCED),
        (claim("exact", 0.90, digits=2), 0.8949, None, NOT),
        (claim("exact", 0.90, digits=2), 0.8985, False, NOT),
        (claim("exact", 1e-14, between=[3.2e-15, 3.2e-14]), 1.55e-14, None, REPRODUCED),
        (claim("exact", 1e-14, between=[3.2e-15, 3.2e-14]), 3.3e-14, None, NOT),
        (claim("config", 0.003), 3e-3, None, REPRODUCED),
        (claim("config", 0.003), 0.0031, None, NOT),
        (claim("config", "64x64x3"), "64x64x3", None, REPRODUCED),
        (claim("config", "64x64x3"), "64x64x4", None, NOT),
        (claim(margin=0.05), 0.95, True, REPRODUCED),  # on the margin
        (claim(margin=0.05), 0.85, None, NOT),
        (claim(margin=0.05), 0.951, True, SAME),
        (claim(margin=0.05), 0.951, None, NOT),
        (claim(margin=0.05), 0.9, False, NOT),
        (claim(margin=0.05), [0.9, 0.96], True, SAME),  # every case of ours has to be close
        (claim(paper=[0.0, 0.68], margin=[0.05, 0.1]), [0.04, 0.6], True, REPRODUCED),
        (claim(paper=[0.0, 0.68], margin=[0.05, 0.1]), [0.06, 0.68], True, SAME),
        (claim(paper=[0.0, 0.68], margin=0.1), [0.06, 0.57], None, NOT),
        (claim(paper="10 of 12", margin=0.1), "11 of 12", True, REPRODUCED),
        (claim(paper="10 of 12", margin=0.1), "8 of 12", None, NOT),
        (claim(paper="10 of 12", margin=0.1), 0.75, True, REPRODUCED),
        (claim(at_least=0.935), 0.935, True, REPRODUCED),
        (claim(at_least=0.935), 0.93, True, SAME),
        (claim(at_most=0.01), 0.01, True, REPRODUCED),
        (claim(at_most=0.01), [0.0, 0.02], None, NOT),
        (claim(paper=0, equal=0), 0, True, REPRODUCED),
        (claim(paper=0, equal=0), [0, 1], None, NOT),
        (claim(paper=0.5, between=[0.4, 0.6]), [0.4, 0.6], True, REPRODUCED),
        (claim(paper=0.5, between=[0.4, 0.6]), [0.39, 0.5], True, SAME),
        (claim(paper="monotone"), "monotone", True, REPRODUCED),
        (claim(paper="monotone"), "not monotone", None, NOT),
        (claim(paper="one curve", check="a test"), "one curve", None, NOT),
        (claim(paper="one curve", check="a test"), "one curve", True, REPRODUCED),
        (claim(paper=4.2, check="a test"), 9.9, True, REPRODUCED),
        (claim(paper=4.2, check="a test"), 4.2, False, NOT),
        (claim("scene", 10, between=[1, 100]), 7, None, CONTEXT),
        (claim("scene", 10, between=[1, 100]), 0, True, NOT),
        (claim("scene", 209, check="reported"), 500, None, CONTEXT),
        (claim("ours", "not stated"), "5 of 5", None, CONTEXT),
        (claim(at_least=0.9, gate=True), 0.95, None, GATE),
        (claim(at_least=0.9, gate=True), 0.85, True, NOT),
    ],
)
def test_verdict(judged, value, holds, expected):
    finding = Finding(value=value, holds=holds)
    assert verdict(judged, finding, "full") == expected
    assert verdict(judged, finding, "quick") == verdict(judged, finding, "smoke") == ""
    assert verdict(judged, None, "full") == verdict(judged, None, "smoke") == "not run"


def test_hardware_needs_a_robot_until_the_frames_are_real():
    judged = claim("hardware", 0.964, margin=0.05)
    assert verdict(judged, Finding(value=0.96, holds=True), "full") == "needs a robot"
    assert verdict(judged, Finding(value=0.96, real_frames=True, holds=True), "full") == "reproduced"
    assert verdict(judged, Finding(value=0.8, real_frames=True, holds=True), "full") == "same direction"


def test_formulas_of_the_paper_reproduce_its_exact_claims():
    z = 1.25 / (0.05 * 30) * math.sqrt(30) / 0.601
    values = {
        "px.fisher": scipy_stats.fisher_exact([[5, 0], [2, 1]]).pvalue,
        "port.z": z,
        "port.prob": scipy_stats.norm.sf(z),
        "z.max": 1.3 * math.sqrt(60) / 0.55,
        "wire.ratio": 12290 / 66,
        "hw.wilson_decisions": stats.wilson(102, 102)[0],
        "hw.wilson_placements": stats.wilson(34, 34)[0],
    }
    claims = load_claims()
    assert {name: verdict(claims[name], Finding(value=value), "full") for name, value in values.items()} == {
        name: "reproduced" for name in values
    }


# ---------------------------------------------------------------- findings

FEW = """
- {id: e.probe, nb: 02_encoder, kind: measured, refuted: r, paper: 0.9, what: "probe | accuracy", margin: 0.05}
- {id: px.latent.route, nb: 04_pixels, kind: measured, refuted: r, paper: 0.997,
   what: route optimality - latent, margin: 0.05}
- {id: px.range, nb: 04_pixels, kind: measured, refuted: r, paper: [0.98, 1.0], what: range, margin: 0.05}
- {id: px.words, nb: 04_pixels, kind: measured, refuted: r, paper: monotone, what: words}
- {id: px.test, nb: 04_pixels, kind: measured, refuted: r, paper: 4.2, what: judged in words, check: a test, unit: z}
- {id: px.zero, nb: 04_pixels, kind: measured, refuted: r, paper: 0, what: contacts, margin: 0, unit: steps}
- {id: px.set, nb: 04_pixels, kind: config, paper: 256, what: setting}
"""


@pytest.fixture
def few(tmp_path):
    (tmp_path / "few.yaml").write_text(FEW)
    return load_claims(tmp_path / "few.yaml")


def write_encoder(outputs, claims, value=0.91, profile="full"):
    encoder = Findings("02_encoder", outputs, profile, claims)
    encoder.add("e.probe", value, low=value - 0.01, high=value + 0.01, n=1, holds=True, note="tried\nharder")
    return encoder.write()


def write_pixels(outputs, claims, profile="full"):
    pixels = Findings("04_pixels", outputs, profile, claims)
    seeds = np.array([1.0, 0.5, 0.6], dtype=np.float32)
    pixels.add("px.latent.route", seeds.mean(), seeds=seeds, low=0.3, high=1.0, test="rank", p=0.5, holds=False)
    pixels.add(
        "px.range", [np.float64(0.97), 1], low=np.array([0.96, 0.99]), high=[0.98, 1.0], n=np.int64(3), holds=True
    )
    pixels.add("px.words", "monotone", holds=True)
    pixels.add("px.test", 42.0, holds=np.bool_(True))
    pixels.add("px.zero", 3, holds=False)
    return pixels.write(pending=["px.set"])


def test_findings_are_plain_json_with_profile_and_verdict(tmp_path, few):
    path = write_pixels(tmp_path / "new", few)
    content = json.loads(path.read_text())
    assert path == tmp_path / "new" / "results" / "04_pixels.json"
    assert (content["notebook"], content["profile"], content["pending"]) == ("04_pixels", "full", ["px.set"])
    route = content["findings"]["px.latent.route"]
    assert route["seeds"] == pytest.approx([1.0, 0.5, 0.6])
    assert (route["n"], route["holds"], route["verdict"]) == (3, False, "not reproduced")
    assert content["findings"]["px.range"]["value"] == [0.97, 1]
    assert content["findings"]["px.test"]["verdict"] == "reproduced"


@pytest.mark.parametrize(
    "name, value, fields, complaint",
    [
        ("e.probe", 0.5, {}, "e.probe is not one of its claims; they are px.latent.route"),
        ("px.words", "monotone", {"holds": True}, "px.words was already added"),
        ("px.latent.route", math.nan, {}, "value must be finite, got nan"),
        ("px.latent.route", np.float32("inf"), {}, "value must be finite, got inf"),
        ("px.latent.route", 0.5, {"seeds": [0.5, math.nan]}, "seeds must be finite"),
        ("px.latent.route", 0.5, {"low": math.nan, "high": 1.0}, "low must be finite"),
        ("px.latent.route", None, {}, "px.latent.route.value"),
        ("px.latent.route", True, {}, "px.latent.route.value"),
        ("px.latent.route", "high", {}, "value 'high' is not comparable with the paper's 0.997"),
        ("px.range", 0.98, {}, "is not comparable with the paper's (0.98, 1.0)"),
        ("px.range", [0.9, 0.95, 1.0], {}, "is not comparable"),
        ("px.latent.route", [], {}, "is not comparable"),
        ("px.latent.route", 0.5, {"low": 0.6, "high": 0.5}, "expected low <= high"),
        ("px.range", [0.9, 1.0], {"low": 0.8, "high": 1.0}, "expected low <= high"),
        ("px.latent.route", 0.5, {"low": 0.4}, "low and high go together"),
        ("px.latent.route", 0.5, {"p": 1.5}, "p"),
        ("px.latent.route", 0.5, {"n": 0}, "n: must be greater than 0"),
        ("px.latent.route", 0.5, {"interval": 1}, "interval: unknown parameter"),
        ("px.test", 4.2, {}, "holds must be True or False"),
    ],
)
def test_bad_findings_are_one_clear_line(tmp_path, few, name, value, fields, complaint):
    pixels = Findings("04_pixels", tmp_path, "full", few)
    pixels.add("px.words", "monotone", holds=True)
    with pytest.raises(UserError) as caught:
        pixels.add(name, value, **fields)
    assert complaint in str(caught.value)
    assert str(caught.value).startswith(f"04_pixels: {name}")
    assert "\n" not in str(caught.value)
    assert list(pixels.found) == ["px.words"]


@pytest.mark.parametrize(
    "pending, complaint",
    [
        ([], "no finding for e.probe"),
        (["px.words"], "px.words is listed as pending but is not one of its claims"),
    ],
)
def test_findings_must_be_complete(tmp_path, few, pending, complaint):
    with pytest.raises(UserError, match=complaint):
        Findings("02_encoder", tmp_path, "full", few).write(pending)
    assert not (tmp_path / "results").exists()


def test_a_finding_cannot_be_pending_too(tmp_path, few):
    encoder = Findings("02_encoder", tmp_path, "full", few)
    encoder.add("e.probe", 0.9, holds=True)
    with pytest.raises(UserError, match=r"e\.probe is listed as pending but was added"):
        encoder.write(["e.probe"])


def test_unknown_notebooks_and_unwritable_folders_are_refused(tmp_path, few):
    with pytest.raises(UserError, match="unknown notebook '4_pixels'; known: 01_occlusion_check"):
        Findings("4_pixels", tmp_path, "full", few)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write in the folder"):
        write_encoder(tmp_path / "file", few)


# ---------------------------------------------------------------- scoreboard


def make_board(outputs, claims, profile="full"):
    findings = scoreboard.read_findings(outputs, claims, profile)
    return scoreboard.join(claims, findings, profile), findings


def test_board_has_one_row_a_claim_in_order(tmp_path, few):
    write_pixels(tmp_path, few)
    board, _ = make_board(tmp_path, few)
    assert list(board.columns) == scoreboard.COLUMNS
    assert list(board.id) == list(few)
    assert list(board.verdict) == ["not run", NOT, REPRODUCED, REPRODUCED, REPRODUCED, NOT, "not run"]
    assert board.ours[2] == [0.97, 1]
    assert board.p[1] == 0.5
    assert board.low[0] is None


def test_board_without_any_results_reads_not_run():
    board, _ = make_board(ROOT / "no such folder", load_claims(), "smoke")
    assert set(board.verdict) == {"not run"}
    assert scoreboard.summary(board).startswith("Of 113 independent measured claims: 113 not run (0 fragile).")


def test_summary_counts_in_order_of_merit(tmp_path, few):
    write_encoder(tmp_path, few, value=0.8)
    write_pixels(tmp_path, few)
    board, _ = make_board(tmp_path, few)
    counted = "Of 6 independent measured claims: 3 reproduced, 1 same direction, 2 not reproduced (0 fragile)."
    assert scoreboard.summary(board) == f"{counted} Counted apart: settings and exact numbers 0 of 1."


def test_a_row_that_follows_another_a_gate_and_a_setting_are_counted_apart(tmp_path, few):
    write_encoder(tmp_path, few)
    write_pixels(tmp_path, few)
    claims = dict(few)
    claims["e.probe"] = few["e.probe"].model_copy(update={"gate": True})
    claims["px.range"] = few["px.range"].model_copy(update={"follows": "px.latent.route"})
    board, _ = make_board(tmp_path, claims)
    assert scoreboard.summary(board) == (
        "Of 4 independent measured claims: 2 reproduced, 2 not reproduced (0 fragile). Counted apart: "
        "settings and exact numbers 0 of 1, rows that follow from another 1, gates 1."
    )


def test_deviations_come_worst_first_with_their_notes(tmp_path, few):
    write_encoder(tmp_path, few, value=0.8)
    write_pixels(tmp_path, few)
    unlike = scoreboard.deviations(make_board(tmp_path, few)[0])
    assert list(unlike.id) == ["px.latent.route", "px.zero", "e.probe"]
    assert unlike.note.iloc[2] == "tried\nharder"
    assert list(unlike[scoreboard.DISCUSSED]) == ["04_pixels", "04_pixels", "02_encoder"]


def alter(path, change):
    """Changes a results file as if a notebook had written it so."""
    content = json.loads(path.read_text())
    content.pop("sha256")
    change(content)
    path.write_text(json.dumps(content))


def test_every_deviation_on_the_committed_board_is_discussed_in_its_notebook():
    rows = csv.DictReader((ROOT / "outputs" / "full" / "scoreboard.csv").open(encoding="utf-8"))
    deviating = [row for row in rows if row["verdict"] in ("same direction", "not reproduced")]
    assert deviating
    for row in deviating:
        source = json.loads((ROOT / "notebooks" / f"{row['notebook']}.ipynb").read_text(encoding="utf-8"))
        prose = "".join("".join(cell["source"]) for cell in source["cells"] if cell["cell_type"] == "markdown")
        named = re.findall(r"`([a-z]+\.[\w.*]+)`", prose)
        assert any(fnmatch(row["id"], pattern) for pattern in named), f"{row['notebook']} says nothing of {row['id']}"


def test_an_id_in_two_files_is_an_error(tmp_path, few):
    entry = json.loads(write_encoder(tmp_path, few).read_text())["findings"]["e.probe"]
    alter(write_pixels(tmp_path, few), lambda content: content["findings"].update({"e.probe": entry}))
    with pytest.raises(UserError, match=r"e\.probe is in two files: 02_encoder\.json and 04_pixels\.json"):
        make_board(tmp_path, few)


@pytest.mark.parametrize(
    "change, complaint",
    [
        (
            lambda c: c["findings"].update(who=c["findings"]["px.words"]),
            "04_pixels.json: who is not in claims.yaml",
        ),
        (
            lambda c: c["findings"].update({"e.probe": c["findings"]["px.words"]}),
            "e.probe belongs to 02_encoder",
        ),
        (lambda c: c["findings"].pop("px.words"), "04_pixels.json: no finding for px.words"),
        (lambda c: c["pending"].clear(), "04_pixels.json: no finding for px.set"),
        (
            lambda c: c.update(profile="smoke"),
            "04_pixels.json: made with profile smoke, but this scoreboard is for full",
        ),
        (lambda c: c.update(notebook="02_encoder"), "04_pixels.json: was written by 02_encoder"),
        (lambda c: c["findings"]["px.zero"].update(value=math.nan), "px.zero"),
        (lambda c: c["findings"]["px.zero"].update(p="low"), "04_pixels.json.findings.px.zero.p"),
        (lambda c: c.pop("pending"), "04_pixels.json.pending: Field required"),
    ],
)
def test_altered_results_are_one_clear_line(tmp_path, few, change, complaint):
    alter(write_pixels(tmp_path, few), change)
    with pytest.raises(UserError) as caught:
        make_board(tmp_path, few)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_one_flipped_bit_in_a_results_file_is_told(tmp_path, few):
    path = write_pixels(tmp_path, few)
    whole = path.read_bytes()
    for place in range(0, len(whole), 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with contextlib.suppress(UserError):
            make_board(tmp_path, few)
            assert json.loads(path.read_bytes()) == json.loads(whole)  # white space says nothing


@pytest.mark.parametrize("content", [b'{"notebook": "04_pix', b"[1]", b"\xff\xfe"])
def test_truncated_or_foreign_results_are_refused(tmp_path, few, content):
    write_pixels(tmp_path, few).write_bytes(content)
    with pytest.raises(UserError, match=r"04_pixels\.json: not a results file"):
        make_board(tmp_path, few)


def test_written_board_reads_back(tmp_path, few):
    write_encoder(tmp_path, few, value=0.8)
    write_pixels(tmp_path, few)
    board, _ = make_board(tmp_path, few)
    scoreboard.write(board, tmp_path, "full")
    with (tmp_path / "scoreboard.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == scoreboard.COLUMNS
    assert [row["id"] for row in rows] == list(few)
    assert json.loads(rows[2]["paper"]) == [0.98, 1.0]
    assert (rows[1]["p"], rows[6]["ours"]) == ("0.5", "")
    text = (tmp_path / "scoreboard.md").read_text()
    assert f"**{scoreboard.summary(board)}**" in text
    told = "≈ same direction |  | tried harder | [02_encoder](notebooks/02_encoder.ipynb) |"
    assert f"| e.probe | probe \\| accuracy | 0.900 | 0.800 [0.790, 0.810] |  |  | {told}" in text
    assert "| px.range | range | measured | 0.980, 1.000 | 0.970 [0.960, 0.980], 1 [0.990, 1.000] | 3 |" in text
    assert text.index("## Not as in the paper") < text.index("## 02_encoder") < text.index("## 04_pixels")
    assert "profile" not in text


def test_smaller_profiles_are_stamped(tmp_path, few):
    write_encoder(tmp_path, few, profile="smoke")
    write_pixels(tmp_path, few, profile="smoke")
    board, _ = make_board(tmp_path, few, "smoke")
    assert "6 without a verdict" in scoreboard.summary(board)
    assert scoreboard.stamp(board, "smoke") == "SMOKE: not a result (profile smoke, n = 1 to 3)"
    assert scoreboard.stamp(board, "quick") == "QUICK: not a result (profile quick, n = 1 to 3)"
    text = scoreboard.markdown(board, "smoke")
    assert text.count("SMOKE: not a result") == 3  # the head and each table
    assert "? no verdict |" in text
    assert "SMOKE: not a result" in scoreboard.styled(board, board, "smoke").to_html()


def test_headline_is_the_route_optimality_of_every_message(tmp_path, few):
    write_pixels(tmp_path, few)
    assert scoreboard.headline(make_board(tmp_path, few)[0]).splitlines() == [
        "| message | n | paper | ours | p | verdict |",
        "| --- | --- | --- | --- | --- | --- |",
        "| latent | 3 | 0.997 | 0.700 [0.300, 1.000] | 0.5 | ✘ not reproduced |",
    ]
    names = scoreboard.headline(make_board(tmp_path / "none", load_claims())[0]).splitlines()[2:]
    assert len(names) == 12


def test_picture_of_a_notebook_shows_every_measured_number(tmp_path, few):
    write_encoder(tmp_path, few, value=0.8)
    write_pixels(tmp_path, few)
    rows = forest.shown(make_board(tmp_path, few)[0], few)
    assert list(rows.id) == ["e.probe", "px.latent.route", "px.range", "px.test", "px.zero"]
    fig = forest.figure(rows, few, "full")
    upper, lower = ([label.get_text() for label in axes.get_yticklabels()] for axes in fig.axes)
    assert [len(upper), len(lower)] == [3, 2] and upper[0] == few["e.probe"].what
    marks = [line for line in fig.axes[0].lines if line.get_marker() == "D"]
    assert sorted(float(line.get_xdata()[0]) for line in marks) == [0.9, 0.98, 0.997, 1.0]
    colours = {line.get_marker(): line.get_color() for line in fig.axes[0].lines}
    assert colours["^"] == scoreboard.MARKS[SAME].colour
    assert [line.get_xdata()[0] for line in fig.axes[1].lines if line.get_marker() == ">"] == [forest.WIDEST] * 2
    assert fig.texts == []


def test_overview_has_a_box_and_a_sign_for_every_independent_claim(tmp_path, few):
    write_encoder(tmp_path, few, value=0.8)
    write_pixels(tmp_path, few)
    board, _ = make_board(tmp_path, few)
    fig = forest.overview(board, "full")
    signs = [text.get_text() for text in fig.axes[0].texts if text.get_color() == "white"]
    assert sorted(signs) == sorted(scoreboard.MARKS[kind].sign for kind in scoreboard.independent(board).verdict)
    assert len(fig.axes[0].patches) == len(signs)
    assert [label.get_text().split()[0] for label in fig.axes[0].get_yticklabels()] == ["Encoder", "Rendered"]


def test_pictures_of_a_smaller_profile_are_stamped_across():
    claims = load_claims()
    board, _ = make_board(ROOT / "no such folder", claims, "smoke")
    rows = forest.shown(board, claims)
    for fig in (forest.overview(board, "smoke"), forest.figure(rows[rows.notebook == "04_pixels"], claims, "smoke")):
        assert [text.get_text() for text in fig.texts if text is not fig._suptitle] == ["SMOKE: not a result"]
        fig.savefig(buffer := io.BytesIO(), dpi=20)
        assert buffer.tell() > 1000


# --- pages with numbers from the results
def test_a_template_takes_its_numbers_from_the_results_and_leaves_out_lines_that_have_none():
    template = "**{{px.a:.1%}}**, paper {{paper px.a:.2f}}\n- {{cov.b[1]:.1f}} of two\n- {{rad.c}}\n| {{rad.c}} |"
    assert filled(template, {"px.a": 0.5, "cov.b": [1, 2]}, {"px.a": 0.25}) == "**50.0%**, paper 0.25\n- 2.0 of two"
    with pytest.raises(UserError, match="nothing was found for 'px.a'"):
        filled(template, {}, {})


def test_every_number_of_a_template_is_a_claim_or_a_prediction():
    known = {*load_claims(), *read_entries(PREDICTIONS, Prediction, "id")}
    for path in TEMPLATES.glob("*.md"):
        assert {found["id"] for found in NUMBER.finditer(path.read_text(encoding="utf-8"))} <= known, path.name
