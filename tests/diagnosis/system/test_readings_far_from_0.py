"""Readings with a large constant, such as seconds since the epoch, are diagnosed as those about 0."""

import numpy as np
import pytest

from probewise.diagnosis import audit_system, diagnose_system
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.noise_law import white_noise
from probewise.diagnosis.noise_models import NoiseModel
from probewise.diagnosis.templates import templates_of_effect
from probewise.effects import Extent
from probewise.effects.noise import Dropouts
from probewise.systems import Simulator, table_for

EPOCH = 1.7e9
N = 60
X = np.sin(0.7 * np.arange(N))
Y = 1.0 + 2.0 * X + 0.1 * np.random.default_rng(1).standard_normal(N) + 0.25 * (np.arange(N) > 35)


def clock(constant: float) -> Simulator:
    priors = {"a": (constant - 5, constant + 5), "b": (-5, 5)}
    return Simulator("y", "s", priors, simulate=lambda p, u: p["a"] + p["b"] * u["x"], time="t")


def table(constant: float) -> dict[str, np.ndarray]:
    return {"t": np.arange(float(N)), "x": X, "y": constant + Y}


@pytest.mark.parametrize("name", ["offset_step", "lag", "offset_drift"])
def test_a_template_is_the_same_about_a_large_constant(name):
    columns = []
    for constant in (0.0, EPOCH):
        prepared = prepare_system(clock(constant), table_for(clock(constant), table(constant)))
        model = Model(prepared.null, (), prepared.recording.plan)
        found = fit(model, prepared.recording, np.zeros(2), white_noise(N))
        templates = templates_of_effect(found, prepared.effects[name], prepared.usable_rows)
        columns.append(np.concatenate(templates.columns, axis=1))
    sizes = np.abs(columns[0]).max(axis=0)
    assert (sizes > 0.01).all()
    # A step of the last digit is 2e-7, and the amplitude is found by changes ten thousand times smaller.
    np.testing.assert_allclose(columns[1] / sizes, columns[0] / sizes, atol=0.1)


def test_a_step_is_found_in_readings_by_the_epoch():
    diagnosis = diagnose_system(clock(EPOCH), table(EPOCH), rng=np.random.default_rng(1))
    assert diagnosis.p_value < 1e-6
    assert "offset_step" in {name for h in diagnosis.judged.hypotheses[:3] for name in h.effects}


def test_a_plan_of_readings_by_the_epoch_is_audited():
    simulator = Simulator(
        "y", "s", {"a": (100 * EPOCH - 5, 100 * EPOCH + 5)}, simulate=lambda p, u: p["a"] + 40 * u["x"], time="t"
    )
    assert audit_system(simulator, {"t": np.arange(float(N)), "x": X}).effects


def test_readings_lost_to_one_value_are_no_other_ones_near_it():
    """Two rows read one value, one row is an outlier 0.7 away; all three are far from what is predicted."""
    recording = prepare_system(clock(EPOCH), table_for(clock(EPOCH), table(EPOCH))).recording
    readings = recording.readings.copy()
    readings[[5, 20]], readings[30] = EPOCH - 6.0, EPOCH - 5.3
    recording = recording.with_readings(readings)
    lost = Dropouts.for_extent(Extent.of(recording))
    nodes = NoiseModel((lost,), recording).nodes_for_predictions(EPOCH + 1.0 + 2.0 * X)
    assert {tuple(np.flatnonzero(law.lost)) for law in nodes.laws} == {(5, 20)}
