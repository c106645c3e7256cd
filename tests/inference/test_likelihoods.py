"""Likelihoods against quadrature and by hand."""

import math

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from scipy import special
from scipy.integrate import quad
from scipy.stats import norm, rankdata

from probewise._arrays import logsumexp
from probewise.errors import ParameterError, ShapeError
from probewise.experiment.judgement import mean_ranks
from probewise.inference import (
    GaussianKnown,
    Naive,
    SensorProblem,
    StudentT,
    log_sigma_integral,
    reading_span,
    sd_ceiling,
    sd_floor,
    student_t_of,
)
from probewise.priors import Product, Uniform
from probewise.recordings.plan import Instrumentation, Plan, Recording


def recording(readings, scan=None, **inst):
    n = len(readings)
    codes = [0] * n if scan is None else scan
    plan = Plan(
        x_mm=np.arange(n),
        y_mm=np.zeros(n),
        orientation_rad=np.zeros(n),
        time_s=np.arange(n),
        scan=codes,
        scan_names=tuple(str(k) for k in range(max(codes) + 1)),
        pattern=np.zeros(n, dtype=int),
        pattern_names=("only",),
        instrumentation=Instrumentation(**inst),
    )
    return Recording(plan, np.array(readings, dtype=float))


class Line:
    """A model of two parameters, for composing."""

    names = ("slope", "start")

    def predict(self, theta, plan):
        return theta[:, :1] * plan.x_mm + theta[:, 1:2]


def by_quadrature(square, n, low, high):
    """The integral over ln sigma by Gauss and Legendre, in panels that widen away from the peak."""

    def height(s):
        return -n * s - 0.5 * square * np.exp(-2 * s)

    a, b = math.log(low), math.log(high)
    peak = min(max(0.5 * math.log(square / n), a), b) if square > 0 else a
    width = 1 / max(math.sqrt(2 * n), abs(-n + square * math.exp(-2 * peak)))
    marks = peak + width * np.concatenate([-(2.0 ** np.arange(40, -2, -1)), 2.0 ** np.arange(-1, 41)])
    edges = np.unique(np.clip(np.concatenate([[a, b, peak], marks]), a, b))
    node, weight = leggauss(40)
    half = np.diff(edges)[:, None] / 2
    top = float(height(np.array(peak)))
    values = np.exp(height((edges[:-1, None] + half) + half * node) - top)
    return top + math.log(float((values * weight * half).sum()))


@pytest.mark.parametrize("n", [1, 2, 4, 14, 101, 404, 5000])
@pytest.mark.parametrize("rms", [0.0, 1e-9, 1e-3, 0.04, 0.6, 5.0, 80.0, 3000.0])
def test_the_integral_over_sigma_is_what_quadrature_gives(n, rms):
    """From residuals that vanish to residuals far beyond the ceiling."""
    got = float(log_sigma_integral(n * rms**2, n, 0.05, 60.0))
    assert got == pytest.approx(by_quadrature(n * rms**2, n, 0.05, 60.0), rel=1e-9, abs=1e-8)


def test_student_t_is_a_normalised_density_of_one_reading():
    """With a proper prior of sigma one reading says something, and its density integrates to one."""
    one = StudentT(np.zeros(1), 0.5, 20.0)

    def density(reading):
        return math.exp(one.log_prob(np.array([reading]), np.zeros((1, 1)))[0])

    halves = [quad(density, a, b, epsabs=1e-10)[0] for a, b in ((0, 1), (1, 10), (10, 200))]
    assert 2 * sum(halves) == pytest.approx(1.0, abs=1e-6)
    assert density(0.0) > density(1.0) > density(5.0)


def test_student_t_multiplies_over_data_sets():
    """Paper: the joint likelihood is the product over data sets."""
    rng = np.random.default_rng(1)
    readings, predicted = rng.normal(size=9), rng.normal(size=(3, 9))
    groups = np.array([4, 4, 9, 9, 9, 4, 2, 9, 4])
    whole = StudentT(groups, 0.1, 10.0).log_prob(readings, predicted)
    parts = sum(
        StudentT(groups[groups == g], 0.1, 10.0).log_prob(readings[groups == g], predicted[:, groups == g])
        for g in (2, 4, 9)
    )
    assert whole == pytest.approx(parts, abs=1e-12)


def test_gaussian_likelihoods_add_up_normal_densities():
    rng = np.random.default_rng(2)
    readings, predicted = rng.normal(size=6), rng.normal(size=(4, 6))
    sd = rng.uniform(0.5, 2, 6)
    expected = norm.logpdf(readings, predicted, sd).sum(axis=1)
    assert GaussianKnown(sd).log_prob(readings, predicted) == pytest.approx(expected)
    assert GaussianKnown(0.7).log_prob(readings, predicted) == pytest.approx(
        norm.logpdf(readings, predicted, 0.7).sum(axis=1)
    )


def test_a_few_hypotheses_at_a_time_are_weighed_as_all_at_once(monkeypatch):
    rec = recording([0.1, 1.2, float("nan"), 2.9])
    sensor = Product({"slope": Uniform(0, 2), "start": Uniform(-1, 1)})
    problem = SensorProblem(sensor, Line(), GaussianKnown(0.5), rec)
    theta = sensor.from_unit_cube(np.random.default_rng(0).random((7, 2)))
    together = problem.log_likelihood(theta)
    monkeypatch.setattr("probewise.inference.problem._MOST_NUMBERS", 9)  # two hypotheses of four readings each
    assert problem.log_likelihood(theta) == pytest.approx(together)


def test_the_naive_likelihood_knows_two_levels():
    """Paper, naive likelihood, with the exponent's sign and the square of sigma put right."""
    naive = Naive(mu_black=10, sd_black=1, mu_white=60, sd_white=3)
    readings = np.array([11.0, 58.0, 30.0])
    predicted = np.array([[10.0, 60.0, 60.0], [10.0, 10.0, 10.0]])
    got = naive.log_prob(readings, predicted)
    assert got[0] == pytest.approx(norm.logpdf(11, 10, 1) + norm.logpdf(58, 60, 3) + norm.logpdf(30, 60, 3))
    assert got[1] == pytest.approx(norm.logpdf(readings, 10, 1).sum())


def test_the_naive_levels_come_from_known_black_and_white():
    naive = Naive.estimated([10, 10, 10], [58, 60, 62], sd_floor=0.3)
    assert (naive.mu_black, naive.sd_black, naive.mu_white, naive.sd_white) == (10, 0.3, 60, 2)
    with pytest.raises(ParameterError, match="black"):
        Naive.estimated([10], [58, 60], sd_floor=0.3)


def test_the_floor_is_that_of_rounding_or_a_thousandth_of_the_span():
    assert sd_floor(recording([10, 60], step=1)) == pytest.approx(1 / math.sqrt(12))
    assert sd_floor(recording([10, 60])) == pytest.approx(0.05)
    assert sd_floor(recording([0, 1000], step=1)) == pytest.approx(1.0)
    assert sd_ceiling(recording([10, 60])) == 50
    assert reading_span(recording([5, 5], min=0, max=100)) == 100
    assert reading_span(recording([5, 5])) == 1


def test_a_data_set_is_a_scan_unless_told_otherwise():
    rec = recording([1, 2, float("nan"), 4], scan=[0, 0, 1, 1])
    assert student_t_of(rec).groups.tolist() == [0, 0, 1]
    assert student_t_of(rec, np.array([5, 6, 7, 8])).groups.tolist() == [5, 6, 8]


def test_shapes_and_bounds_are_checked():
    with pytest.raises(ParameterError, match="floor"):
        StudentT(np.zeros(3), 1.0, 1.0)
    with pytest.raises(ShapeError, match="groups has 3 values for 4 readings"):
        StudentT(np.zeros(3), 0.1, 1.0).log_prob(np.zeros(4), np.zeros((2, 4)))
    with pytest.raises(ShapeError, match=r"\(n_samples, n_points\)"):
        GaussianKnown(1.0).log_prob(np.zeros(4), np.zeros((2, 3)))
    with pytest.raises(ParameterError, match="sd"):
        GaussianKnown(0.0)


def test_weights_tell_the_gradient_by_the_predictions():
    """Far from the bounds of sigma: central differences of the log likelihood, data sets of 5 and 3 readings."""
    rng = np.random.default_rng(21)
    likelihood = StudentT(np.array([0, 0, 7, 0, 7, 7, 0, 0]), sd_floor=1e-4, sd_ceiling=1e4)
    readings, predicted = rng.normal(size=8), rng.normal(size=(3, 8))
    gradient = np.empty_like(predicted)
    for k in range(8):
        shift = 1e-5 * np.eye(8)[k]
        up, down = (likelihood.log_prob(readings, predicted + side * shift) for side in (1, -1))
        gradient[:, k] = (up - down) / 2e-5
    off = readings - predicted
    np.testing.assert_allclose(off * likelihood.inverse_noise_variance(off), gradient, rtol=1e-5, atol=1e-7)


def test_sums_of_exponentials_and_ranks_are_those_of_scipy():
    """Its functions take ten times as long, or half a second to import."""
    rng = np.random.default_rng(5)
    table = np.round(20 * rng.normal(size=(40, 9)), 1)
    table[table < -20] = -np.inf
    table[3] = -np.inf
    assert logsumexp(table) == special.logsumexp(table)
    for axis in (0, 1):
        np.testing.assert_array_equal(logsumexp(table, axis=axis), special.logsumexp(table, axis=axis))
    values = rng.integers(9, size=25).astype(float)
    np.testing.assert_array_equal(mean_ranks(values), rankdata(values))
