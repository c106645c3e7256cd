"""Predictions and residuals of the repaired model, and where effects show."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np

from probewise.diagnosis.diagnosis import (
    Diagnosis,
    PredictionAndResiduals,
    _controls_before_time,
    predictions_before_and_after,
)
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.locate import Place
from probewise.diagnosis.noise import white_noise
from probewise.diagnosis.prepared import Prepared, rows_to_diagnose
from probewise.effects.effect import Binding
from probewise.recordings import Plan, Recording, Uniform

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
