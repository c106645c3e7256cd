"""A diagnosis put together by hand."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from probewise.diagnosis import Diagnosis, Judged, VerdictReport
from probewise.diagnosis.judgement.judged import Hypothesis
from probewise.diagnosis.light_sensor.sensor import LightSensorApparatus
from probewise.diagnosis.search.weighed_twice import Weighing
from probewise.diagnosis.verdict_report.document import _weighing_json
from probewise.diagnosis.verdict_report.findings import EffectFound

JUDGED = Judged("clean", (), 0.4, (Hypothesis((), 1.0),))
FOUND = Diagnosis(None, JUDGED, None, (), None, VerdictReport("All is explained.", (), None), None)


def test_what_is_read_most_is_at_hand():
    assert (FOUND.verdict, FOUND.reason, FOUND.p_value) == ("clean", "All is explained.", 0.4)


def test_a_name_that_never_was_is_no_attribute():
    with pytest.raises(AttributeError, match="credibility"):
        FOUND.credibility  # noqa: B018


def test_an_effect_that_is_there_twice_is_written_twice_by_its_name():
    twice = ("interference", "interference~again")
    weighing = Weighing(twice, 0, -10.0, -10.1, 0.1)
    assert weighing.label == "interference+interference"
    assert _weighing_json(weighing)["effects"] == ["interference", "interference"]
    effects = tuple(EffectFound(name, 0.9, 9.0, f"a wave, {k}", ()) for k, name in enumerate(twice))
    repair = SimpleNamespace(
        changes_predictions=False,
        by_rows=False,
        improvement=None,
        after_in_words="repaired",
        combination_shares={twice: 1.0},
        shares_in_words="two waves in the readings",
        unstated_effects=lambda stated: (),
    )
    found = replace(
        FOUND,
        recording=SimpleNamespace(plan=SimpleNamespace(instrumentation=SimpleNamespace(unit_after_number="V"))),
        report=replace(FOUND.report, effects=effects),
        repair=repair,
        apparatus=LightSensorApparatus(),
    )
    assert "again" not in found.summary()
