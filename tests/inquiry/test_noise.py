"""The noise of a reading: its density, distribution, draws and nodes are those of one law."""

import math

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from probewise.errors import ParameterError, ShapeError
from probewise.inquiry import ReadingNoise
from probewise.priors import LogUniform, Uniform

LAWS = {
    "gaussian": ReadingNoise(0.5),
    "student": ReadingNoise(0.5, dof=3.0),
    "outliers": ReadingNoise(0.5, outliers=0.2, between=(-4.0, 9.0)),
}
ONE = np.array([[0.5]])


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("reading", [-1.0, 1.2, 3.0])
def test_the_distribution_is_the_integral_of_the_density(name, reading):
    law, at = LAWS[name], np.array([[1.0]])
    density = lambda y: math.exp(law.log_density(np.array([y]), at, ONE)[0, 0])  # noqa: E731
    below = quad(density, -400, reading, points=[-4.0, 0.0, 1.0], limit=200)[0]
    assert law.cdf(np.array([reading]), at, ONE)[0, 0] == pytest.approx(below, abs=2e-5)


def test_the_densities_are_those_of_scipy():
    reading, at = np.array([1.7]), np.array([[1.0]])
    normal = stats.norm(1.0, 0.5).logpdf(1.7)
    mixed = math.log(0.8 * math.exp(normal) + 0.2 / 13)
    assert LAWS["gaussian"].log_density(reading, at, ONE)[0, 0] == pytest.approx(normal)
    assert LAWS["student"].log_density(reading, at, ONE)[0, 0] == pytest.approx(stats.t(3, 1.0, 0.5).logpdf(1.7))
    assert LAWS["outliers"].log_density(reading, at, ONE)[0, 0] == pytest.approx(mixed)


@pytest.mark.parametrize("name", LAWS)
def test_draws_follow_the_distribution(name):
    law, n = LAWS[name], 4000
    drawn = law.draw(np.ones((n, 1)), np.full((n, 1), 0.5), rng=np.random.default_rng(1))[:, 0]
    p_value = stats.kstest(drawn, lambda y: law.cdf(y, np.ones(len(y)), np.full(len(y), 0.5))).pvalue
    assert p_value > 1e-4


def test_the_sd_may_be_a_function_of_the_prediction_or_a_parameter():
    predicted = np.array([[1.0, 4.0], [9.0, 16.0]])
    np.testing.assert_allclose(ReadingNoise(np.sqrt).scale(predicted, None), [[1, 2], [3, 4]])
    assert ReadingNoise(LogUniform(0.1, 1.0)).is_sd_inferred
    np.testing.assert_allclose(
        ReadingNoise(LogUniform(0.1, 1.0)).scale(predicted, np.array([0.2, 0.3]))[:, 1], [0.2, 0.3]
    )


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"sd": 0.0}, "noise sd is 0.0; allowed: a number greater than 0, a function"),
        ({"sd": "0.1"}, "noise sd is '0.1'; allowed: a number"),
        ({"sd": LogUniform}, "noise sd is <class .*; allowed: a number"),
        ({"sd": Uniform(-1.0, 1.0)}, "a prior of numbers greater than 0"),
        ({"sd": 1.0, "dof": 0.0}, "dof is 0.0; allowed: greater than 0"),
        ({"sd": 1.0, "outliers": 1.0}, "outliers is 1.0; allowed: 0 or more, below 1"),
        ({"sd": 1.0, "outliers": 0.1}, "between is None; allowed: .low, high."),
        ({"sd": 1.0, "outliers": 0.1, "between": (3.0, 1.0)}, "between is .3.0, 1.0.; allowed"),
    ],
)
def test_what_is_no_noise_is_refused_in_words(arguments, said):
    with pytest.raises(ParameterError, match=said):
        ReadingNoise(**arguments)


def test_a_sd_that_is_not_positive_or_of_another_shape_is_refused():
    with pytest.raises(ParameterError, match=r"noise sd of the predicted reading -1 is -1.0; allowed: finite"):
        ReadingNoise(lambda y: y).scale(np.array([[2.0, -1.0]]), None)
    with pytest.raises(ShapeError, match=r"returns shape \(3,\); allowed: \(2,\)"):
        ReadingNoise(lambda y: np.ones(3)).scale(np.array([[2.0, 1.0]]), None)


@pytest.mark.parametrize("name", LAWS)
def test_the_tail_far_above_is_as_small_as_the_one_far_below(name):
    """Also where one minus the probability of a smaller reading would be nought."""
    law, at = LAWS[name], np.array([[2.5]])  # the middle of the outliers' range
    sds = np.array([1.0, 8.0, 9.0, 20.0])
    above, below = (law.smaller_tail(2.5 + 0.5 * z, at, ONE)[0] for z in (sds, -sds))
    np.testing.assert_allclose(above, below, rtol=1e-9)
    if name == "gaussian":
        np.testing.assert_allclose(above, stats.norm.sf(sds), rtol=1e-9)
