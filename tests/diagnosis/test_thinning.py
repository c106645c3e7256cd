"""Which rows of a long recording are diagnosed."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from function_null import FunctionNull

from probewise.diagnosis import diagnose, findings
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.prepared import positions_in_stretches, prepare, rows_to_diagnose
from probewise.diagnosis.verdict import Hypothesis
from probewise.effects import VOCABULARY
from probewise.priors import Normal, Product
from probewise.recordings import HalfPlane, Plan, Recording
from probewise.report.covariate import covariate_values_by_place


def recording(n_scans: int, per_scan: int) -> Recording:
    n = n_scans * per_scan
    plan = Plan(
        x_mm=np.tile(np.linspace(-50, 50, per_scan), n_scans),
        y_mm=np.zeros(n),
        orientation_rad=np.zeros(n),
        time_s=np.arange(n, dtype=float),
        scan=np.repeat(np.arange(n_scans), per_scan),
        scan_names=tuple(f"s{k}" for k in range(n_scans)),
        pattern=np.zeros(n),
        pattern_names=("edge",),
        patterns={"edge": HalfPlane(0.0, 0.0)},
    )
    return Recording(plan, np.sin(plan.x_mm))


def test_a_short_recording_is_taken_whole():
    np.testing.assert_array_equal(rows_to_diagnose(recording(4, 100), 400), np.arange(400))


def test_of_many_scans_whole_ones_are_taken_from_first_to_last():
    whole = recording(100, 40)
    rows = rows_to_diagnose(whole, 800)
    scans, counts = np.unique(whole.plan.scan[rows], return_counts=True)
    assert len(rows) == 800
    np.testing.assert_array_equal(counts, 40)
    assert (scans[0], scans[-1]) == (0, 99)


def test_of_few_long_scans_stretches_are_taken_from_each():
    whole = recording(3, 5000)
    rows = rows_to_diagnose(whole, 1000)
    assert len(rows) == pytest.approx(1000, rel=0.05)
    np.testing.assert_allclose(np.bincount(whole.plan.scan[rows]), len(rows) / 3, rtol=0.05)
    assert np.mean(np.diff(rows) == 1) > 0.8


def test_scans_of_an_effect_have_their_numbers_in_the_whole_recording(monkeypatch):
    prepared = prepare(recording(100, 40), apparatus=LightSensorApparatus())
    assert prepared.is_thinned
    last = next(e for e in prepared.effects["scan_angle_error"].variants() if e.scans == ("s99",))
    samples = SimpleNamespace(effects=("scan_angle_error",), effect_samples=lambda name: np.full((500, 1), 2.0))
    best = SimpleNamespace(fit=SimpleNamespace(found=SimpleNamespace(model=SimpleNamespace(effects=(last,)))), noise=())
    monkeypatch.setattr(findings, "_lambda_of", lambda *_: 9.0)
    hypotheses = (Hypothesis(("scan_angle_error",), 1.0),)
    searched = SimpleNamespace(prepared=prepared)
    (found,) = findings.effects_found(searched, hypotheses, best, samples, rng=np.random.default_rng(0))
    assert found.parameters[-1].name == "scans"
    assert found.parameters[-1].interval95 == (99.0, 99.0)


def test_places_of_a_thinned_recording_are_drawn_over_all_of_it_and_scans_have_their_own_numbers():
    """A page of more than 2,400 readings could not be written."""
    whole = recording(30, 100)
    noise = np.random.default_rng(0).standard_normal(3000)
    noise[5] = np.nan
    whole = Recording(whole.plan, noise + 2.0 * (whole.plan.scan >= 20))
    level = FunctionNull(lambda p, plan: p["level"] * np.ones((1, len(plan))), Product({"level": Normal(0.0, 10.0)}))
    known = {"ambient_step": VOCABULARY["ambient_step"]}
    found = diagnose(whole, null=level, effects=known, rng=np.random.default_rng(0))
    values = covariate_values_by_place(found)
    rows = rows_to_diagnose(whole)
    rows = rows[whole.usable[rows]]
    assert f"(From {len(rows)} of 2999 readings, evenly spread.)" in found.reason
    np.testing.assert_array_equal(values["witness_time.svg"][rows], whole.plan.time_s[rows])
    (scan,) = (place for place in found.where if place.covariate == "scan")
    np.testing.assert_array_equal(values[scan.figure_name][rows], whole.plan.scan[rows])
    assert np.isfinite(values[scan.figure_name]).sum() == len(rows)
    np.testing.assert_array_equal(scan.curve_at, np.unique(whole.plan.scan[rows]))


@pytest.mark.parametrize("n", [2401, 3600, 4800, 9600, 19_200, 100_003])
def test_a_table_that_repeats_itself_is_seen_at_all_hours(n):
    """Within a factor of two of the mean at each hour, in each half of the table."""
    chosen = positions_in_stretches(np.zeros(n, dtype=np.int64), 2400)
    assert len(chosen) == 2400
    for half in (chosen[:1200], chosen[1200:]):
        counts = np.bincount(half % 24, minlength=24)
        assert 25 <= counts.min() <= counts.max() <= 100
    assert np.mean(np.diff(chosen) == 1) > 0.83  # stretches of six
    np.testing.assert_allclose(chosen, np.linspace(0, n - 1, 2400), atol=0.03 * n)  # over the whole table


@pytest.mark.parametrize("interleaved", [False, True])
def test_a_stretch_lies_in_one_run(interleaved):
    n_runs, length = 37, 271
    run = np.arange(n_runs * length) % n_runs if interleaved else np.repeat(np.arange(n_runs), length)
    chosen = positions_in_stretches(run, 2400)
    assert 2300 < len(chosen) <= 2400
    for k in range(n_runs):
        place = np.flatnonzero(np.isin(np.flatnonzero(run == k), chosen))
        streaks = np.diff(np.concatenate([[-1], np.flatnonzero(np.diff(place) != 1), [len(place) - 1]]))
        assert len(streaks) > 5
        assert streaks.min() >= 6


def test_of_very_short_runs_about_as_many_rows_are_chosen():
    assert len(positions_in_stretches(np.arange(9000) // 2, 2400)) == 2400


def test_scans_there_and_back_are_chosen_of_both_ways():
    whole = recording(200, 40)
    kept = np.unique(whole.plan.scan[rows_to_diagnose(whole, 4000)])
    assert len(kept) == 100
    for half in (kept[:50], kept[50:]):
        assert 0.25 < np.mean(half % 2) < 0.75
