"""Where to measure to learn which model is true."""

from math import log2

import numpy as np
import pytest
from scipy.stats import norm

from probewise.errors import ParameterError, ShapeError
from probewise.inquiry import Grid, Readout, Rival, information_about_rivals
from probewise.recordings import HalfPlane
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels, FixedMixture


def rivals(made, one, other, probabilities=(0.5, 0.5)):
    """Each rival is a table of readings, rows its posterior samples, columns three places."""
    return [
        Rival(
            made.sensor(tuple(map(tuple, np.atleast_2d(table)))),
            np.arange(float(len(np.atleast_2d(table))))[:, None],
            p,
        )
        for table, p in zip((one, other), probabilities, strict=True)
    ]


def places(n):
    return Grid(n - 1.0, 1.0, n, 2).plan("field").take(np.arange(n))


def test_models_that_disagree_by_far_are_told_apart_by_one_reading(made):
    bits = information_about_rivals(rivals(made, [10.0, 10.0, 10.0], [10.0, 60.0, 11.0]), places(3), Readout(1.0, 1.0))
    assert bits[0] == pytest.approx(0.0, abs=1e-9)
    assert bits[1] == pytest.approx(1.0, abs=1e-6)
    assert 0.1 < bits[2] < 0.3


def test_no_reading_tells_more_than_there_is_to_know(made):
    bits = information_about_rivals(rivals(made, [0.0, 0.0], [90.0, 0.0], (9.0, 1.0)), places(2), Readout(1.0, 1.0))
    assert bits[0] == pytest.approx(-0.9 * log2(0.9) - 0.1 * log2(0.1), abs=1e-6)


def test_two_gaussian_predictions_have_the_divergence_of_quadrature(made):
    """Jensen and Shannon's divergence of N(30, 1) and N(31.5, 1) on a fine line; cells of half an sd lose a little."""
    y = np.linspace(20, 42, 20001)
    one, other = norm.pdf(y, 30, 1), norm.pdf(y, 31.5, 1)
    mixed = 0.5 * (one + other)
    exact = sum(0.5 * np.trapezoid(p * np.log2(np.maximum(p, 1e-300) / mixed), y) for p in (one, other))
    bits = information_about_rivals(rivals(made, [30.0, 30.0], [31.5, 30.0]), places(2), Readout(1.0))
    assert bits[0] == pytest.approx(exact, rel=0.03)


def test_what_both_models_are_unsure_of_tells_nothing(made):
    """A place where either predicts the same wide spread, beside one where their spreads differ."""
    spread = np.linspace(10.0, 60.0, 51)
    one = np.stack([spread, spread], axis=1)
    other = np.stack([spread, np.full(51, 35.0)], axis=1)
    bits = information_about_rivals(rivals(made, one, other), places(2), Readout(1.0, 1.0))
    assert bits[0] == pytest.approx(0.0, abs=1e-6)
    assert bits[1] > 0.5


def test_one_gaussian_or_two_is_asked_where_the_second_reaches():
    """A faint wide second Gaussian: the reading that tells is beyond the first one's edge, not on it."""
    scene = KnownScene({"field": HalfPlane(normal_rad=0.0, offset_mm=20.0)})
    first = [[9.0, 0.0], [0.0, 9.0]]
    models = [
        Chain(FixedMixture([1.0], [[0.0, 0.0]], [first]), FixedLevels(10.0, 60.0), scene),
        Chain(
            FixedMixture([0.8, 0.2], [[0.0, 0.0]] * 2, [first, [[200.0, 0.0], [0.0, 200.0]]]),
            FixedLevels(10.0, 60.0),
            scene,
        ),
    ]
    grid = Grid(40.0, 1.0, 41, 2)
    bits = information_about_rivals(
        [Rival(model, np.empty((1, 0)), 1.0) for model in models],
        grid.plan("field").take(np.arange(41)),
        Readout(1.0, 1.0),
    )
    away = np.abs(grid.x_mm[int(bits.argmax())] - 20.0)
    assert 4.0 < away < 12.0
    assert bits[20] < 1e-6  # on the edge both read midway


def test_rivals_that_are_none_are_refused(made):
    one, other = rivals(made, [1.0, 2.0], [1.0, 2.0])
    with pytest.raises(ParameterError, match="two models or more"):
        information_about_rivals([one], places(2), Readout(1.0))
    with pytest.raises(ParameterError, match="probability"):
        Rival(one.model, one.theta, -1.0)
    with pytest.raises(ShapeError, match="one sample or more"):
        Rival(one.model, np.empty((0, 1)), 1.0)
    assert information_about_rivals([one, other], places(2), Readout(1.0)) == pytest.approx([0.0, 0.0], abs=1e-9)
