import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from probewise.calibration import FittedSensor, predict, read_sensor, write_sensor
from probewise.effects import Origin
from probewise.errors import DoubtfulResultWarning, FileError, ShapeError
from probewise.recordings import Disc, Instrumentation, Plan, Recording, paper_plan
from probewise.scene import KnownScene
from probewise.sensor import Chain, FreeLevels, FreeMixture


def _chain(plan):
    return Chain(FreeMixture(1), FreeLevels(), KnownScene(plan.patterns))


def _disc_plan():
    """A pattern, angles and scans that no calibration had."""
    x = np.linspace(-30, 30, 21)
    patterns = {"disc": Disc((0.0, 0.0), 15.0)}
    return Plan.from_arrays(x_mm=x, y_mm=4.0, orientation_rad=np.linspace(0, 1, 21), patterns=patterns, unit="LEGO")


@pytest.mark.parametrize("plan", [paper_plan(), _disc_plan()])
def test_mean_and_sd_are_those_of_simulated_new_readings(sensor, plan):
    """By brute force: a prediction for every sample, noise added to each."""
    rng = np.random.default_rng(14)
    each = _chain(plan).predict(sensor.samples, plan)
    n_new = 60
    sum_, squares = np.zeros(len(plan)), np.zeros(len(plan))
    for _ in range(n_new):
        new = each + sensor.noise_sd[:, None] * rng.standard_normal(each.shape)
        sum_ += new.sum(axis=0)
        squares += ((new - each.mean(axis=0)) ** 2).sum(axis=0)
    n = n_new * len(each)
    found = predict(sensor, plan)
    assert np.abs(found.mean - sum_ / n).max() < 5 * found.sd.max() / math.sqrt(n)
    np.testing.assert_allclose(found.sd, np.sqrt(squares / n), rtol=0.02)
    assert np.isnan(found.log_density).all()


def test_the_log_density_is_the_mixture_over_the_samples(sensor, truth):
    plan = _disc_plan()
    readings = _chain(plan).predict(truth[None], plan)[0] + 1.0
    each = _chain(plan).predict(sensor.samples, plan)
    expected = np.log(stats.norm.pdf(readings, each, sensor.noise_sd[:, None]).mean(axis=0))
    np.testing.assert_allclose(predict(sensor, plan, readings).log_density, expected, rtol=1e-9)


def test_a_declared_step_gives_masses_of_cells_that_sum_to_one(sensor):
    plan = replace(_disc_plan(), instrumentation=Instrumentation(step=1.0)).take(np.array([10]))
    total = sum(math.exp(float(predict(sensor, plan, [float(k)]).log_density[0])) for k in range(0, 101))
    assert total == pytest.approx(1.0, abs=1e-9)


def test_effects_carry_over_but_those_of_single_scans_do_not(sensor, make_sensor):
    """Gear play of 2 mm shifts a one-way scan by 1 mm."""
    extra = {"scan_misplacement.offset_mm": 5.0, "backlash.width_mm": 2.0}
    plan = paper_plan().take(np.arange(101))
    found = predict(make_sensor(effects=("scan_misplacement", "backlash"), extra=extra), plan)
    shifted = replace(plan, x_mm=plan.x_mm - 1.0)
    np.testing.assert_allclose(found.mean, predict(sensor, shifted).mean, rtol=1e-12)


def test_effects_count_from_the_time_of_the_recording_that_was_diagnosed(make_sensor, tmp_path):
    """A sensor of times in seconds since 1970, from its file, predicts as one of the same times from 0."""
    columns = {"gain_drift.frac": 0.2, "gain_drift.tau_s": 30.0, "position_scale.x": 0.05, "position_scale.y": 0.0}
    from_0 = make_sensor(effects=("gain_drift", "position_scale"), extra=columns)
    since_1970 = replace(from_0, origins=dict.fromkeys(from_0.effects, Origin(time_s=1.7e9, x_mm=2e4)))
    write_sensor(since_1970, tmp_path / "sensor.json")
    back = read_sensor(tmp_path / "sensor.json")
    assert back.origins == since_1970.origins
    plan = paper_plan().take(np.arange(101))
    edge = plan.patterns["boundary"]
    far = replace(
        plan,
        time_s=plan.time_s + 1.7e9,
        x_mm=plan.x_mm + 2e4,
        patterns={"boundary": replace(edge, offset_mm=edge.offset_mm + 2e4)},
    )
    np.testing.assert_allclose(predict(back, far).mean, predict(from_0, plan).mean, atol=1e-6)
    with pytest.warns(DoubtfulResultWarning, match="lie before 1700000000 s, from which gain_drift counts"):
        predict(back, replace(far, time_s=plan.time_s))


def test_a_sensor_file_of_before_counts_from_0(make_sensor):
    drifting = make_sensor(effects=("offset_drift",), extra={"offset_drift.per_hour": 2.0})
    document = json.loads(replace(drifting, origins={"offset_drift": Origin(time_s=3.0)}).to_json())
    document.pop("origins")
    (of_before,) = FittedSensor.from_json(json.dumps(document)).effects_on_new_scans
    assert of_before.binding.where.origin == Origin()
    for damaged in ({"time_s": "noon"}, {"hours": 3.0}, 3):
        with pytest.raises(FileError):
            FittedSensor.from_json(json.dumps(document | {"origins": {"offset_drift": damaged}}))
    for damaged in (3, {"backlash": {"time_s": 3.0}}):
        with pytest.raises(FileError):
            FittedSensor.from_json(json.dumps(document | {"origins": damaged}))


def test_heights_without_one_in_the_description_are_warned_of(sensor):
    calibrated = replace(sensor, instrumentation=replace(sensor.instrumentation, height_mm=14.0))
    raised = replace(_disc_plan(), covariates={"height_mm": np.full(21, 28.0)})
    with pytest.warns(DoubtfulResultWarning, match="gives no height_mm of the sensor: predicted as at the height of"):
        predict(calibrated, raised)
    predict(calibrated, replace(raised, covariates={"height_mm": np.full(21, 14.0)}))
    predict(replace(sensor, instrumentation=Instrumentation()), raised)
    lower = predict(calibrated, replace(raised, instrumentation=Instrumentation(height_mm=14.0)))
    assert np.ptp(lower.mean) < 0.5 * np.ptp(predict(calibrated, _disc_plan()).mean)


def test_a_plan_that_declares_another_height_is_predicted_at_it(sensor):
    """As a plan of the calibration's height that commands it; rows that command one of their own keep it."""
    calibrated = replace(sensor, instrumentation=replace(sensor.instrumentation, height_mm=14.0))
    at_14, at_28 = (replace(_disc_plan(), instrumentation=Instrumentation(height_mm=h)) for h in (14.0, 28.0))
    for column in (np.full(21, np.nan), np.where(np.arange(21) < 5, 10.0, np.nan)):
        found = predict(calibrated, replace(at_28, covariates={"height_mm": column}))
        told = replace(at_14, covariates={"height_mm": np.where(np.isfinite(column), column, 28.0)})
        np.testing.assert_array_equal(found.mean, predict(calibrated, told).mean)
        chain = calibrated.chain(KnownScene(at_28.patterns))
        theta, commanded = calibrated.samples_for_new_scans, replace(at_28, covariates={"height_mm": column})
        np.testing.assert_array_equal(chain.predict(theta, commanded), chain.predict(theta, told))
    assert found.plan.instrumentation.height_mm == 28.0
    np.testing.assert_array_equal(predict(calibrated, at_28).mean[5:], found.mean[5:])
    np.testing.assert_array_equal(predict(sensor, at_28).mean, predict(sensor, at_14).mean)  # calibrated at no height


def test_a_plan_without_the_battery_that_an_effect_reads_or_in_another_unit_is_warned_of(make_sensor):
    sags, plan = make_sensor(effects=("battery_sag",), extra={"battery_sag.per_volt": 0.05}), paper_plan()
    predict(sags, plan)  # knows its battery
    with pytest.warns(DoubtfulResultWarning, match="no column battery_mv, which battery_sag reads"):
        predict(sags, replace(plan, covariates={}))
    with pytest.warns(DoubtfulResultWarning, match="'mW'"):
        predict(sags, replace(plan, instrumentation=Instrumentation(unit="mW")))


def test_a_plan_without_rows_predicts_nothing_and_readings_that_do_not_match_are_refused(sensor):
    with pytest.raises(ShapeError, match="one per row"):
        predict(sensor, _disc_plan(), np.zeros(3))
    plan = _disc_plan().take(np.array([], dtype=int))
    assert len(predict(sensor, Recording(plan, np.array([])).plan)) == 0
