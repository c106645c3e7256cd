"""A meter that stands at the end of its range: seen in the readings, named, and carried to predictions."""

import numpy as np
import pytest

from probewise.diagnosis import diagnose_system
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.fit_simulator import repaired_of
from probewise.diagnosis.outlying import find_meter_stop
from probewise.systems import RunTable, Simulator, as_recording, predict_system, table_for

_N, _SD = 240, 0.05


def _simulator(**more):
    return Simulator(
        "y", "V", {"zero": (-10, 10), "slope": (0, 2)}, simulate=lambda p, u: p["zero"] + p["slope"] * u["x"], **more
    )


def _table(readings):
    x = 3 + 2 * np.sin(np.arange(_N) / 12)
    return {"x": x, "y": readings(1.0 + x + _SD * np.random.default_rng(3).standard_normal(_N))}


def _stop(table, **more):
    simulator = _simulator(**more)
    return find_meter_stop(as_recording(simulator, RunTable(table, time=None, run=None)))


def test_a_meter_that_stops_after_its_noise_is_seen():
    found = _stop(_table(lambda y: np.minimum(y, 5.5)))
    assert (found.level, found.is_ceiling, found.rows.sum()) == (5.5, True, np.sum(_table(lambda y: y)["y"] >= 5.5))
    found = _stop(_table(lambda y: np.maximum(y, 2.5)))
    assert (found.level, found.is_ceiling) == (2.5, False)


_NOT_STOPPED = {
    "no stop": lambda y: y,
    "noise after the stop": lambda y: np.minimum(y, 5.5) + 0.01 * np.random.default_rng(1).standard_normal(_N),
    "coarse digits": lambda y: np.round(y, 1),
    "single lost readings": lambda y: np.where(np.arange(_N) % 30 == 0, 9.9, y),
    "constant": lambda y: np.full(_N, 3.0),
}


@pytest.mark.parametrize("case", _NOT_STOPPED)
def test_nothing_is_seen_where_no_meter_stops(case):
    assert _stop(_table(_NOT_STOPPED[case])) is None


def test_lost_readings_at_the_end_of_the_range_are_no_stop():
    lost = np.random.default_rng(6).random(_N) < 0.08
    prepared = prepare_system(_simulator(), table_for(_simulator(), _table(lambda y: np.where(lost, 9.0, y))))
    (effect,) = prepared.apparatus.left_out
    assert (effect.name, effect.known[1]) == ("dropouts", 9.0)
    assert len(prepared.recording.left_out) == lost.sum()


@pytest.mark.slow
def test_a_stop_is_named_and_predicted():
    table = _table(lambda y: np.minimum(y, 5.5))
    found = diagnose_system(_simulator(), table, rng=np.random.default_rng(0))
    assert (found.verdict, found.combination) == ("named", ("saturation",))
    effect = found.effects[0]
    assert effect.parameters[0].interval95 == pytest.approx((5.5, 5.5))
    # Some 60 readings are up to half a volt, ten sds, beyond.
    beyond = np.maximum(1.0 + table["x"] - 5.5, 0) / _SD
    assert effect.size_lambda == pytest.approx(np.linalg.norm(beyond), rel=0.1)
    predicted = predict_system(repaired_of(found), table, rng=np.random.default_rng(1))
    assert predicted.mean.max() == pytest.approx(5.5)
