"""Truths beside intervals: places, angles, moments of the footprint."""

import math

import numpy as np
import pytest

from probewise.diagnosis import EffectFound, ModelSamples, ParameterFound, Place
from probewise.proof.challenge import effect_truths_and_intervals, place_overlap, sensor_truths_and_intervals
from probewise.proof.sensors import CovariateRegion
from probewise.scene import KnownScene
from probewise.sensor import Chain, FreeLevels, FreeMixture
from probewise.world.concealed import flicker
from probewise.world.spots import Blob, gaussian_spot
from probewise.world.world import World


def place(covariate, start=None, end=None, scan=None):
    none = np.zeros(0)
    return Place(covariate, scan, start, end, 0.01, 4.0, none, none)


@pytest.mark.parametrize(
    ("start", "end", "overlap"), [(0.0, 10.0, 1.0), (5.0, 15.0, 1 / 3), (2.0, 6.0, 0.4), (11.0, 15.0, 0.0)]
)
def test_intersection_over_union(start, end, overlap):
    assert place_overlap(CovariateRegion("time", 0.0, 10.0), [place("time", start, end)]) == pytest.approx(overlap)


def test_only_the_strongest_place_of_that_covariate_counts():
    places = [place("level", 0.0, 1.0), place("time", 0.0, 5.0), place("time", 0.0, 10.0)]
    assert place_overlap(CovariateRegion("time", 0.0, 10.0), places) == 0.5
    assert place_overlap(CovariateRegion("slope", 0.0, 10.0), places) == 0.0


def test_a_scan_overlaps_with_the_scans_of_its_mounting():
    region = CovariateRegion("scan", scans=("a", "b"))
    assert place_overlap(region, [place("scan", scan="a")]) == 0.5
    assert place_overlap(region, [place("scan", scan="c")]) == 0.0
    both = [place("scan", scan="a"), place("scan", scan="b"), place("time", 0.0, 1.0)]
    assert place_overlap(region, both) == 1.0
    weaker = Place("scan", "c", None, None, 0.01, 3.0, *[np.zeros(0)] * 2)
    assert place_overlap(region, [*both, weaker]) == 1.0


def found(*parameters):
    own = tuple(ParameterFound(name, unit, (low + high) / 2, 1.0, (low, high)) for name, unit, low, high in parameters)
    return EffectFound("x", 0.9, 8.0, "", own)


def test_an_angle_counts_by_its_nearest_turn():
    stated = found(("phase", "rad", -0.1, 0.1), ("amp", "LEGO", 1.0, 2.0))
    within = effect_truths_and_intervals(flicker(1.5, 0.02, 2 * math.pi - 0.05).parameters, stated)
    assert within["amp"] == [1.5, 1.0, 2.0]
    assert within["phase"] == pytest.approx([-0.05, -0.1, 0.1])


def test_samples_at_the_truth_have_its_moments():
    """One Gaussian: the covariance of the paper's A, B, C is half the inverse of [[A, C], [C, B]]."""
    blob = Blob(1.0, (0.5, 1.5), (4.0, 2.5), 0.3)
    covariance = np.array([[16.0, 3.0], [3.0, 6.25]])
    (a, c), (_, b) = np.linalg.inv(covariance) / 2
    theta = np.tile([1.0, 0.5, 1.5, a, b, c, 10.0, 60.0], (5, 1))
    chain = Chain(FreeMixture(1), FreeLevels(), KnownScene({}), ())
    within = sensor_truths_and_intervals(World(gaussian_spot([blob])), ModelSamples(chain, theta, np.ones(5), 1))
    for truth, low, high in within.values():
        assert (low, high) == pytest.approx((truth, truth), rel=1e-3)
