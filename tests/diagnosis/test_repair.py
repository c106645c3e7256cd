"""The result of a diagnosis: predictions of the repaired model, the gain of a repair, where effects show."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from probewise.diagnosis import NextMeasurement, best_repair
from probewise.diagnosis.apparatus import PriorOdds
from probewise.diagnosis.best_repair import correct_by_best_basis
from probewise.diagnosis.diagnosis import (
    Diagnosis,
    PredictionAndResiduals,
    _controls_before_time,
    _public_names,
    predictions_before_and_after,
)
from probewise.diagnosis.evidence import Linearised, partition_into_blocks
from probewise.diagnosis.findings import EffectFound
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.locate import Place
from probewise.diagnosis.noise import NoiseLaw, white_noise
from probewise.diagnosis.prepared import Prepared, rows_to_diagnose
from probewise.diagnosis.search.thorough import Weighing
from probewise.diagnosis.templates import TemplateBank
from probewise.diagnosis.verdict import Hypothesis, Judged
from probewise.effects.effect import Binding
from probewise.recordings import Plan, Recording, Uniform, two_way_plan
from probewise.scene import Circle

LAG = SimpleNamespace(
    name="lag",
    binding=Binding(),
    covariates=("time",),
    amplitudes=(),
    sentence=lambda mean, sd: f"it lags by {mean[0]:.0f} s",
)


def repair(absent=None, residuals=(1.0, np.nan)):
    model = SimpleNamespace(
        absent=absent or {},
        effects=("lag", "step", "outliers"),
        chain=SimpleNamespace(effects=(LAG,)),
        effect_samples=lambda name: np.array([[2.0], [2.0], [0.0], [0.0]]),
    )
    before = PredictionAndResiduals(np.zeros(2), np.array([1.0, np.nan]))
    after = PredictionAndResiduals(np.zeros(2), np.array(residuals))
    return Diagnosis(
        "clean", (), 1.0, (), recording=None, apparatus=LightSensorApparatus(), reason="", effects=(), noise=None,
        null=model, repaired=model, improvement=None, before=before, after=after,
    )  # fmt: skip


def test_a_model_with_a_formula_in_half_of_its_samples_is_not_said_to_lack_the_correction():
    assert repair().not_in_model == "sensor.json does not contain it"
    formula = "formula:reading:y:x^2"
    marks = {formula: np.array([True, False, True, False])}
    own = repair(marks)
    model = SimpleNamespace(absent=marks, effects=("lag", formula))
    said = replace(own, repaired=model).not_in_model
    assert said == "of the samples in sensor.json, 50 % contain a formula for it instead"


def test_what_is_corrected_row_by_row_is_not_called_repaired():
    assert repair().after_in_words == "repaired"
    assert replace(repair(), by_rows=True).after_in_words == "corrected in these readings"


def test_what_is_carried_and_not_stated_is_said_of_the_samples_that_hold_it():
    marks = {"lag": np.array([False, False, True, True])}
    assert repair(marks).unstated_effects == (("lag", 0.5, "it lags by 2 s"),)
    assert replace(repair(marks), effects=(LAG,)).unstated_effects == ()


@dataclass(frozen=True)
class Constant:
    """A model that predicts one level, z, in every row of a plan."""

    plan: Plan

    def predict(self, z):
        return np.repeat(z[:, :1], len(self.plan), axis=1)


def fitted(recording, level):
    model = Constant(recording.plan)
    return SimpleNamespace(model=model, z=np.array([level]), residuals=recording.readings - level)


def test_a_correction_by_rows_stands_at_the_readings_that_were_used_of_a_long_recording():
    """5,000 readings of level 7, of which about half are diagnosed; the repaired model's level is 5."""
    n = 5000
    table = {"x_mm": np.arange(n) / n, "y_mm": np.zeros(n), "reading": np.full(n, 7.0)}
    everything = Recording.from_table(table, patterns=Uniform(0.5), unit="LEGO")
    rows = rows_to_diagnose(everything)
    assert len(rows) < n
    recording = everything.take(rows)
    prepared = Prepared(recording, {}, None, None, everything)
    best = SimpleNamespace(
        calibrated=fitted(recording, 4.0),
        repaired=fitted(recording, 5.0),
        improvement=None,
        problem=SimpleNamespace(law=white_noise(len(rows))),
    )
    before, after = predictions_before_and_after(prepared, best, np.full(len(rows), 2.0))
    np.testing.assert_array_equal(before.readings, 4.0)
    used = np.isin(np.arange(n), rows)
    np.testing.assert_array_equal(after.readings[used], 7.0)
    np.testing.assert_array_equal(after.residuals[used], 0.0)
    np.testing.assert_array_equal(after.readings[~used], 5.0)
    np.testing.assert_array_equal(after.residuals[~used], 2.0)


def place(covariate, values, start, end):
    return Place(covariate, None, start, end, 0.001, 5.0, *[np.zeros(0)] * 2, values=values)


def test_a_control_comes_before_time_where_both_hold_the_same_rows():
    time = np.arange(100.0)
    power = np.minimum(time // 10, 9.0)
    rows = [place("level", time, 0, 9), place("time", time, 50, 89), place("power_w", power, 5.0, 8.0)]
    ordered = [p.covariate for p in _controls_before_time(rows, ("power_w",))]
    assert ordered == ["level", "power_w", "time"]
    assert [p.covariate for p in _controls_before_time(rows, ())] == ["level", "time", "power_w"]
    elsewhere = [*rows[:2], place("power_w", power, 0.0, 3.0)]
    assert [p.covariate for p in _controls_before_time(elsewhere, ("power_w",))] == ["level", "time", "power_w"]


PLAN = two_way_plan()


def test_blocks_are_kept_back_whole_and_every_reading_once():
    readings = np.ones(len(PLAN))
    readings[:3] = np.nan
    part, names = partition_into_blocks(Recording(PLAN, readings))
    assert len(part) == len(PLAN) - 3
    assert sorted(np.unique(part)) == list(range(len(names)))
    ends = np.flatnonzero(np.diff(part)) + 1
    assert (np.diff(ends) == 8).all()


_N = 120
_BUMP = np.exp(-0.5 * ((np.arange(_N) - 60) / 15) ** 2)
_PARTS = (np.arange(_N) // 8) % 5


def _corrected(law, noise):
    """Return the correction of a fitted constant by the bump, which the readings contain once."""
    residuals = _BUMP + noise
    found = SimpleNamespace(slopes=10 * np.ones((_N, 1)), residuals=residuals, z=np.zeros(1), sd=0.1)
    problem = Linearised.of(found, law)
    bank = TemplateBank.of([_BUMP[:, None]], ["time"])
    return found, problem, correct_by_best_basis(found, problem, bank, _PARTS)


def _law(**more):
    given = {"sd": np.ones(_N), "carry": np.zeros(_N), "lost": np.zeros(_N, dtype=bool), **more}
    return NoiseLaw(**given)


def test_lost_readings_do_not_count():
    rng, lost = np.random.default_rng(2), np.zeros(_N, dtype=bool)
    lost[[5, 40, 62, 90]] = True
    noise = 0.1 * rng.standard_normal(_N)
    _, _, found = _corrected(_law(lost=lost), np.where(lost, -50.0, noise))
    _, _, elsewhere = _corrected(_law(lost=lost), np.where(lost, 70.0, noise))
    assert np.abs(found.change - _BUMP).max() < 0.1
    np.testing.assert_allclose(found.change, elsewhere.change)
    assert found.held_out == elsewhere.held_out
    assert found.held_out.per_reading > 4 * found.held_out.sd


@pytest.mark.parametrize(("clean", "predicts", "weight"), [(0.3, False, 0.05), (0.3, True, None), (0.01, False, None)])
def test_what_is_unknown_and_predicts_nothing_has_its_prior_odds_beside_a_law_that_may_be_complete(
    monkeypatch, clean, predicts, weight
):
    """.06 to .6 against nothing on the mean, .3 of the probability: .05 times the .6 that it has."""
    asked = []
    fixed = SimpleNamespace(held_out=SimpleNamespace(per_reading=0.1 if predicts else -0.1))
    monkeypatch.setattr(best_repair, "best_correction", lambda *more: (fixed, ()))
    monkeypatch.setattr(best_repair.BestRepair, "of", lambda *more, **options: "repair")
    monkeypatch.setattr(best_repair, "judge", lambda *more, unknown_weight: asked.append(unknown_weight) or judged)
    hypotheses = (
        Hypothesis(("unknown",), 0.6),
        Hypothesis((), clean / 2),
        Hypothesis(("outliers",), clean / 2),
        Hypothesis(("lag",), 0.4 - clean),
    )
    judged = Judged("unknown", ("unknown",), 0.004, hypotheses)
    searched = SimpleNamespace(
        leading_combination_out_of_vocabulary=lambda: (),
        likeliest_fit_beside_unknown=lambda noise: None,
        prior=PriorOdds(),
        prepared=SimpleNamespace(noise_effect_names=frozenset({"outliers"})),
    )
    test = SimpleNamespace(null=None, noise=())
    found = best_repair.judged_and_best_repair(searched, test, judged, rng=np.random.default_rng(0))
    assert found == (judged, "repair")
    assert asked == ([] if weight is None else [pytest.approx(weight)])


PREDICTED = PredictionAndResiduals(np.zeros(2), np.zeros(2))
FOUND = Diagnosis(
    "clean", (), 0.4, (Hypothesis((), 1.0),), apparatus=LightSensorApparatus(), reason="All is explained.", effects=(),
    before=PREDICTED, after=PREDICTED, **dict.fromkeys(("recording", "noise", "null", "repaired", "improvement")),
)  # fmt: skip


def test_an_effect_that_is_there_twice_is_written_twice_by_its_name():
    twice = ("interference", "interference~again")
    weighing = Weighing(twice, 0, -10.0, -10.1, 0.1)
    assert weighing.label == "interference+interference"
    assert _public_names(weighing.effects) == ["interference", "interference"]
    effects = tuple(EffectFound(name, 0.9, 9.0, f"a wave, {k}", ()) for k, name in enumerate(twice))
    model = SimpleNamespace(
        absent=dict.fromkeys(twice, np.zeros(1, dtype=np.bool_)), effects=twice, chain=SimpleNamespace(effects=())
    )
    found = replace(
        FOUND,
        recording=SimpleNamespace(
            plan=SimpleNamespace(instrumentation=SimpleNamespace(unit_after_number="V")), weighting_in_words=""
        ),
        effects=effects,
        repaired=model,
    )
    assert "again" not in found.summary()


def test_the_field_of_a_next_plan_is_described_as_it_is_believed_to_be():
    known = {"field": Uniform(0.0), "card": Uniform(0.5)}
    plan = Plan.from_arrays(x_mm=[0.0, 5.0], y_mm=0.0, pattern=["field", "card"], patterns=known, unit="V")
    plan = replace(plan, patterns={"card": Uniform(0.5)})
    asked = NextMeasurement(plan, "read again", 1.0, 9.0, ("a", "b"), ((), ("lag",)), np.eye(2))
    names = ("sd", "x_mm", "y_mm", "radius_mm")
    model = SimpleNamespace(chain=SimpleNamespace(names=names), theta=np.array([[1.0, 90.0, 40.0, 50.0]] * 3))
    diagnosis = replace(FOUND, repaired=model, next_measurement=asked)
    described = diagnosis.with_shape_in_next_plan(Circle()).next_measurement.plan.patterns
    assert described["card"] == Uniform(0.5)
    corners = np.array(described["field"].vertices_mm)
    np.testing.assert_allclose(np.hypot(*(corners - [90.0, 40.0]).T), 50.0, rtol=0.01)
    without = replace(diagnosis, next_measurement=None)
    assert without.with_shape_in_next_plan(Circle()) is without
