"""Settings that the paper does not print: inferred by rule, from rows that then count for nothing."""

from functools import reduce

import numpy as np
import pytest
import yaml
from scipy.stats import t as student

from lt_lib.gridworld.views import rescaled
from lt_lib.learnability.score_function import train_point_mass
from lt_lib.report import stats
from lt_lib.report.claims import CALIBRATED, NOT_REPRODUCED, Finding, load_claims, verdict
from lt_lib.report.inferred import RECORD, Choice, calibrating_rows, load_inferred, registered
from lt_lib.report.registration import register, register_each
from lt_lib.report.scoreboard import independent, join
from lt_lib.settings.base import ROOT, UserError
from lt_lib.settings.devices import computing_precision
from lt_lib.settings.learnability import PointMassConfig
from lt_lib.settings.profiles import load_profile

INFERRED, FULL = load_inferred(), load_profile("full")
# where the ranges stand in the full profile, notebook and parameter
RANGES = {
    "05_coverage_sweep.navigator.steps": ("05_coverage_sweep", "pretraining", "looks"),
    "04_pixels.pixel_study.head.minibatch": ("04_pixels", "minibatches"),
    "08_hardware_decode.executor.steps": ("08_hardware_decode", "lengths"),
    "03_gridworld.gridworld.scaled": ("03_gridworld", "forms"),
}


def entry(path):
    """What the full profile holds at a dotted path, or None where it keeps a default."""
    return reduce(lambda part, name: part.get(name) if isinstance(part, dict) else None, path, FULL)


def test_every_row_exists_and_none_both_calibrates_and_is_predicted():
    claims = load_claims()
    for setting in INFERRED.values():
        assert {*setting.calibrates, *setting.predicts} <= claims.keys()
    predicted = {row for setting in INFERRED.values() for row in setting.predicts}
    assert not predicted & calibrating_rows().keys()


@pytest.mark.parametrize("name", RANGES)
def test_the_range_that_runs_is_the_range_that_was_registered_and_the_value_in_use_is_in_it(name):
    assert entry(RANGES[name]) == list(INFERRED[name].tried)
    assert entry(name.split(".")) in INFERRED[name].tried


def test_the_point_mass_runs_over_the_registered_range_and_uses_a_value_of_it():
    tried, book = INFERRED["06_z_study.point_mass"].tried, FULL["06_z_study"]
    assert (book["grids"], book["scores"], book["budgets"]) == (tried["distances"], tried["score"], tried["budgets"])
    used = PointMassConfig(**book["point_mass"])
    assert list(used.distances) in tried["distances"] and used.score in tried["score"]
    assert used.budgets[-1] in tried["budgets"] and set(tried["budgets"]) <= set(book["looks"])


def test_the_curriculum_in_use_is_one_of_those_tried():
    assert (
        FULL["05_coverage_sweep"]["pretraining"]["curriculum"]
        in INFERRED["05_coverage_sweep.pretraining.curriculum"].tried
    )


def test_the_rules_pick_the_nearest_and_the_largest_and_the_first_of_equals():
    length, curriculum = (
        INFERRED[f"05_coverage_sweep.{name}"] for name in ("navigator.steps", "pretraining.curriculum")
    )
    (paper,) = length.target
    assert length.choose({1: paper - 0.2, 2: paper + 0.1, 3: paper - 0.11}) == 2
    assert length.choose({3: paper + 0.25, 1: paper - 0.25}) == 3
    assert curriculum.choose({"a": 0.2, "b": 0.9, "c": 0.9}) == "b"
    joint = INFERRED["06_z_study.point_mass"]
    assert joint.choose({"near": (4.3, 3.1), "one right": (4.2, 4.0)}) == "near"
    with pytest.raises(ValueError, match="expected 2 numbers per value"):
        joint.choose({"a": 4.2})
    assert "in use" in str(Choice(1, 1)) and str(Choice(1, 2)).startswith("here the rule picks 1; 2 is in use")


@pytest.mark.parametrize("row", calibrating_rows())
def test_a_calibrating_row_counts_for_nothing_whatever_it_says(row):
    claim = load_claims()[row]
    for holds in (True, False):
        value = [9.0, 9.0] if isinstance(claim.paper, tuple) else claim.paper
        finding = Finding(value=value, holds=holds)
        assert verdict(claim, finding, "full") == CALIBRATED
        assert row not in set(independent(join({row: claim}, {row: finding}, "full")).id)
    assert verdict(claim, finding, "quick") != CALIBRATED


def test_words_that_no_value_of_a_setting_makes_true_are_not_reproduced():
    claim = load_claims()["grid.zero_value"]
    assert claim.calibrates and verdict(claim, Finding(value="no", holds=False), "full") == NOT_REPRODUCED


def test_a_changed_file_is_told_and_a_broken_one_refused(tmp_path):
    path, record = tmp_path / "inferred.yaml", tmp_path / RECORD
    path.write_text("a: 1")
    assert not register("settings", path.read_bytes(), record).changed
    path.write_text("a: 2")
    assert "CHANGED AFTER THE FACT: the settings were registered" in str(
        register("settings", path.read_bytes(), record)
    )
    record.write_text("nothing")
    with pytest.raises(UserError, match="not a record of registered settings"):
        register("settings", path.read_bytes(), record)
    for text, complaint in {
        "a: 1": "expected a list",
        "- {setting: a}": "inferred.yaml: a.what: Field required",
        yaml.safe_dump([next(iter(yaml.safe_load((ROOT / "params/inferred.yaml").read_text())))] * 2): "appears twice",
    }.items():
        path.write_text(text)
        with pytest.raises(UserError, match=complaint):
            load_inferred(path)
    assert "unchanged" in str(registered(tmp_path / "outputs"))


# --- the settings themselves
def test_every_prediction_is_registered_on_its_own(tmp_path):
    record = tmp_path / "registered.json"
    assert not register_each("predictions", {"a": b"1", "b": b"2"}, record).changed
    later = register_each("predictions", {"a": b"1", "c": b"3"}, record)
    assert not later.changed and set(later.first_use) == {"a", "c"} and "none changed since" in str(later)
    moved = register_each("predictions", {"a": b"1", "c": b"4"}, record)
    assert moved.changed == ["c"] and "CHANGED AFTER THE FACT" in str(moved)
    record.write_text("[1]")
    with pytest.raises(UserError, match="not a record of registered predictions") as error:
        register_each("predictions", {"a": b"1"}, record)
    assert "\n" not in str(error.value)


def test_a_mean_score_is_a_sum_at_a_rate_divided_by_the_window():
    shared = {"window": 10, "seeds": 2, "optimiser": "sgd", "batch": 32, "budgets": (50,), "evaluation": 256}
    mean = train_point_mass(PointMassConfig(**shared, score="mean", lr=1.0), 0, report=lambda _: None)
    total = train_point_mass(PointMassConfig(**shared, score="sum", lr=0.1), 0, report=lambda _: None)
    np.testing.assert_allclose(mean["policy"], total["policy"], rtol=1e-9)
    other = train_point_mass(PointMassConfig(**shared, score="sum", lr=1.0), 0, report=lambda _: None)
    assert not np.allclose(mean["policy"], other["policy"])


def test_the_three_forms_of_a_latent():
    rng = np.random.default_rng(0)
    weights = {"mean": rng.normal(size=64), "std": rng.uniform(0.5, 2, 64), "E.x": np.ones(1)}
    raw = weights["mean"] + weights["std"] * rng.standard_normal((20_000, 64))
    forms = {how: rescaled(weights, how) for how in ("each", "one", "none")}
    entered = {how: (raw - form["mean"]) / form["std"] for how, form in forms.items()}
    np.testing.assert_allclose(entered["each"].std(0), 1, atol=0.03)
    assert np.ptp(entered["one"].std(0)) > 0.5 and abs(entered["one"].var(0).mean() - 1) < 0.03
    np.testing.assert_array_equal(entered["none"], raw)
    assert all(rescaled(form, how).keys() == weights.keys() for how, form in forms.items())


def test_automatic_precision_is_resolved_when_settings_are_read():
    assert computing_precision("auto") in ("float32", "bfloat16")
    assert computing_precision("float32") == "float32" and computing_precision(3) == 3


# --- tests of means over seeds
def test_means_over_seeds_are_tested_by_students_t_and_single_seeds_exactly():
    rng = np.random.default_rng(0)
    spread = np.stack([rng.permutation(1000) < 1000 * share for share in (0.1, 0.3, 0.5)])
    shares = spread.mean(axis=1)
    t = (shares.mean() - 0.05) / (shares.std(ddof=1) / np.sqrt(3))
    assert stats.mean_above(spread, 0.05) == pytest.approx(float(student.sf(t, 2)), rel=1e-6)
    assert stats.mean_below(spread, 0.05) > 0.9
    one = spread[:1]
    assert stats.mean_above(one, 0.05) == stats.above(int(one.sum()), one.size, 0.05)
    assert stats.mean_below(one, 0.2) == pytest.approx(stats.below(int(one.sum()), one.size, 0.2))
    alike = np.repeat(one, 3, axis=0)  # seeds that agree are no certainty: the episodes' error remains
    assert stats.mean_above(alike, 0.09) == stats.above(int(alike.sum()), alike.size, 0.09) > 0
    assert stats.mean_less(np.zeros_like(spread), spread) == pytest.approx(stats.longer_mean(shares, np.zeros(3)))
    assert stats.mean_less(one, ~one) == stats.fewer((int(one.sum()), 1000), (int((~one).sum()), 1000))
    assert stats.mean_less(spread, spread) > 0.4
