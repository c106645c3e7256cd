"""The arm's own error, one for all readings, in what a run claims of its shape."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
from exploring import run
from scipy.special import ndtr

from probewise.arm import read_geometry, shipped_geometry_path
from probewise.arm.geometry import FITTED, RULER_SDS, Accuracy, place_jacobian
from probewise.errors import ParameterError
from probewise.experiment import FittedArm, estimated_shape, result_json, samples_csv
from probewise.experiment.arm_error import arm_error_in_posterior
from probewise.inquiry import Grid

ARM = dataclasses.replace(read_geometry(shipped_geometry_path()), field_mm=(400.0, 300.0), axis_mm=(200.0, 360.0))
LEVELS = DARK, WHITE = 10.0, 60.0


def known_to(sds):
    """Make the geometry of an arm whose errors are independent, one sd a number that is fitted."""
    covariance = np.diag(np.asarray(sds, dtype=float) ** 2)
    return dataclasses.replace(ARM, accuracy=Accuracy(8, 1.0, 1.0, 0.001, tuple(map(tuple, covariance.tolist()))))


def only(name, sd):
    return known_to([sd if each == name else 0.0 for each in FITTED])


@pytest.fixture(scope="module")
def found(request):
    small = request.getfixturevalue("small_for_all")
    experiment = small.experiment(n_particles=3000, stop_sd_mm=0.5)
    return run(small.arm(), experiment, rng=np.random.default_rng(4), max_readings=25)


def with_arm_error(exploration, geometry):
    """A run that has ended, with the error of a fitted arm added to its posterior."""
    last = exploration.last
    experiment = dataclasses.replace(exploration.experiment, fitted_arm=FittedArm(geometry, LEVELS))
    of = (experiment, exploration.readings, last.posterior.theta[:, experiment.shape_columns])
    moments = {name: getattr(last, name) for name in ("mean", "sd", "likely_shape")}
    of += (last.by_kind.with_raised_left_out_odds(),)
    error = arm_error_in_posterior(*of, **moments, rng=np.random.default_rng(1))
    return dataclasses.replace(exploration, steps=(*exploration.steps[:-1], dataclasses.replace(last, arm_error=error)))


def mean_on_a_grid(exploration, off_mm, height_off_mm):
    """Infer the circle anew with every reading elsewhere and at another height, on a grid about what was found."""
    last = exploration.last
    axes = [np.linspace(m - 6 * s - 2, m + 6 * s + 2, 61) for m, s in zip(last.mean, last.sd, strict=True)]
    theta = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    places = np.array([(r.pose.x_mm, r.pose.y_mm) for r in exploration.readings]) + off_mm
    inside = theta[:, 2:] - np.hypot(places[:, 0] - theta[:, :1], places[:, 1] - theta[:, 1:2])
    bright = 50.0 * (1 - 2 * height_off_mm / ARM.read_height_mm)
    values = np.array([r.value for r in exploration.readings])
    log = -0.5 * ((values - DARK - bright * ndtr(inside / 8.0)) ** 2).sum(axis=1)
    weight = np.exp(log - log.max())
    return weight @ theta / weight.sum()


@pytest.mark.parametrize("name", ["base home", "elbow home", "upper link", "base y", "shoulder height"])
def test_the_shape_moves_with_the_arm_as_an_inference_anew_says(found, name):
    sd = {"shoulder height": 0.3}.get(name, float(RULER_SDS[FITTED.index(name)]) / 20)
    claimed = with_arm_error(found, only(name, sd))
    places = np.array([(r.pose.x_mm, r.pose.y_mm) for r in found.readings])
    middle = np.array([ARM.field_mm]) / 2
    off = sd * place_jacobian(ARM, np.concatenate([places, middle]))[:, :, FITTED.index(name)]
    share = 0.3  # of one sd: there all is linear
    ends = [
        mean_on_a_grid(found, way * share * off[:-1, :2], way * share * (off[:-1, 2] - off[-1, 2])) for way in (1, -1)
    ]
    moved = np.abs(ends[0] - ends[1]) / (2 * share)

    np.testing.assert_allclose(claimed.arm_error.sd, moved, atol=0.02 + 0.05 * moved.max())


def test_a_base_that_stands_elsewhere_moves_the_shape_and_does_not_stretch_it(found):
    claimed = with_arm_error(found, only("base x", 3.0))
    np.testing.assert_allclose(claimed.arm_error.sd, [3.0, 0.0, 0.0], atol=0.1)
    np.testing.assert_allclose(claimed.sd, np.hypot(found.last.sd, claimed.arm_error.sd))


def test_samples_files_and_words_are_as_wide_as_readings_and_arm_together(found):
    sds = [0.001, 0.002, 0.002, 1.0, 1.0, 0.7, 0.7, 1.0, 1.0]
    claimed = with_arm_error(found, known_to(sds))
    np.testing.assert_allclose(claimed.posterior.sd(), claimed.sd, rtol=0.05)
    np.testing.assert_allclose(claimed.posterior.mean(), found.last.mean, atol=0.1)
    of_file = {p["name"]: p for p in json.loads(result_json(claimed))["shape"]["parameters"]}
    for k, parameter in enumerate(estimated_shape(claimed).parameters):
        assert parameter.sd == of_file[parameter.name]["sd"] == pytest.approx(claimed.sd[k])
        assert parameter.arm_sd == of_file[parameter.name]["arm_sd"] == pytest.approx(claimed.arm_error.sd[k])
        low, high = parameter.interval95
        assert high - low == pytest.approx(2 * 1.96 * claimed.sd[k], rel=0.1)
    rows = np.array([[float(cell) for cell in line.split(",")] for line in samples_csv(claimed).splitlines()[1:]])
    weight, x_mm = rows[:, 0], rows[:, 1]
    assert np.sqrt(weight @ (x_mm - weight @ x_mm) ** 2) == pytest.approx(claimed.sd[0], rel=0.06)
    assert "its own error makes up x_mm" in claimed.summary()
    assert [p.arm_sd for p in estimated_shape(found).parameters] == [None] * 3
    assert found.last.sd.max() < claimed.sd.max()


def test_a_geometry_that_nobody_fitted_says_nothing_of_the_shape(found):
    with pytest.raises(ParameterError, match=r"\[accuracy\]"):
        with_arm_error(found, ARM)
    far = dataclasses.replace(known_to(RULER_SDS / 10), axis_mm=(200.0, 2000.0))
    with pytest.raises(ParameterError, match="reach"):
        with_arm_error(found, far)


ABOUT_ITS_BASE = dataclasses.replace(known_to(RULER_SDS / 10), axis_mm=(200.0, 150.0))
"""It stands in the middle of its field, which it does not reach."""


def test_an_arm_that_does_not_reach_the_middle_was_calibrated_as_near_to_it_as_it_reaches(small_for_all):
    levels = SimpleNamespace(mean=lambda: {"I_min": DARK, "I_max": WHITE})
    arm = FittedArm.from_geometry_and_sensor(ABOUT_ITS_BASE, levels)
    reached = ABOUT_ITS_BASE.reachable_grid_mm
    away = np.hypot(*(reached - (200.0, 150.0)).T)
    assert np.hypot(*(np.array(arm.calibration_place_mm) - (200.0, 150.0))) == away.min() > 100.0
    assert FittedArm.from_geometry_and_sensor(known_to(RULER_SDS), levels).calibrated_mm is None
    # Its error is known wherever it reads.
    x_mm, y_mm = reached[0].tolist()
    experiment = small_for_all.experiment(fitted_arm=arm, grid=Grid(x_mm, y_mm, 2, 2))

    class There(small_for_all.arm):
        def reachable(self, places_mm):
            return np.array([False, False, False, True])

    found = run(There(), experiment, rng=np.random.default_rng(4), max_readings=1)
    assert np.isfinite(found.arm_error.sd).all()


def test_light_that_falls_less_with_the_height_moves_the_shape_less(found):
    arm = only("elbow home", 0.02)
    square = with_arm_error(found, arm)
    none = dataclasses.replace(arm, light_per_mm=0.0)
    same = dataclasses.replace(arm, light_per_mm=2 / ARM.read_height_mm * (WHITE - DARK) / WHITE)
    claimed = [with_arm_error(found, each).arm_error.sd for each in (same, none)]
    np.testing.assert_allclose(claimed[0], square.arm_error.sd)
    assert (claimed[1] < square.arm_error.sd).all()


@pytest.fixture(scope="module")
def claimed_by(request):
    """Run the same robot over the same field, with an arm that knows where its base stands to so many mm."""
    small = request.getfixturevalue("small_for_all")

    def claimed(sd_mm):
        arm = None if sd_mm is None else FittedArm(only("base x", sd_mm), LEVELS)
        experiment = small.experiment(n_particles=600, stop_sd_mm=1.0, fitted_arm=arm)
        return run(small.arm(), experiment, rng=np.random.default_rng(4), max_readings=25)

    return claimed


def test_a_run_reads_on_until_the_lengths_are_known_arm_included(claimed_by):
    alone, included = claimed_by(None), claimed_by(0.95)
    assert len(included.readings) > len(alone.readings)
    assert alone.readings == included.readings[: len(alone.readings)]  # until then the arm plays no part
    np.testing.assert_allclose(included.arm_error.sd, [0.95, 0.0, 0.0], atol=0.08)
    assert np.hypot(included.last.sd, included.arm_error.sd).max() < 1.0
    assert np.hypot(included.steps[-2].sd, included.steps[-2].arm_error.sd).max() >= 1.0
    assert included.stop_reason == "every length is known to better than 1 mm, the arm's own error included"
    assert included.target_reached


def test_a_run_whose_arm_alone_leaves_too_much_says_so_and_reads_no_further(claimed_by):
    alone, beyond = claimed_by(None), claimed_by(1.5)
    assert len(beyond.readings) == len(alone.readings) < 25
    assert beyond.stop_reason.startswith("the readings know every length to better than 1 mm, but the arm's own error")
    assert "leaves 1.5 mm, which no reading lowers" in beyond.stop_reason
    assert not beyond.target_reached
    assert beyond.sd.max() > 1.5
