"""The result of a diagnosis."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from probewise.diagnosis import Diagnosis, NextMeasurement
from probewise.diagnosis.diagnosis import PredictionAndResiduals, _public_names
from probewise.diagnosis.findings import EffectFound
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.search.thorough import Weighing
from probewise.diagnosis.verdict import Hypothesis
from probewise.recordings import Plan, Uniform
from probewise.scene import Circle

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
