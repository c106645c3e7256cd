"""A straight line with known noise: posterior and evidence have a closed form."""

import json

import numpy as np
import pytest

from probewise.diagnosis import fit_json, fit_simulator
from probewise.errors import ParameterError
from probewise.systems import Simulator

X = np.linspace(-1.0, 1.0, 60)
RNG = np.random.default_rng(5)
Y = 1.0 + 2.0 * X + 0.1 * RNG.standard_normal(60)


def line(**options):
    given = {"simulate": lambda p, data: p["a"] + p["b"] * data["x"], "noise": {"sd": 0.1}, **options}
    return Simulator("y", "V", {"a": ("normal", 0, 3), "b": ("normal", 0, 3)}, **given)


@pytest.fixture(scope="module")
def fitted():
    return fit_simulator(line(), {"x": X, "y": Y}, rng=np.random.default_rng(1))


def test_the_posterior_of_a_line_is_that_of_least_squares(fitted):
    (b, a), covariance = np.polyfit(X, Y, 1, cov=True)
    median = dict(zip(fitted.fitted.names, np.median(fitted.fitted.samples, axis=0), strict=True))
    sd = fitted.fitted.samples.std(axis=0)
    np.testing.assert_allclose([median["a"], median["b"]], [a, b], atol=0.2 * np.sqrt(covariance[1, 1]))
    np.testing.assert_allclose(sd, np.sqrt(np.diag(covariance))[::-1], rtol=0.15)


def test_nested_sampling_and_laplace_agree_on_the_evidence_of_a_line(fitted):
    """A line's posterior is all but normal: Laplace is exact to within a tenth of a nat."""
    assert fitted.evidence.method == "nested sampling"
    one_by_one = line(simulate=lambda p, data: np.array([float(p["a"]) + float(p["b"]) * x for x in data["x"]]))
    laplace = fit_simulator(one_by_one, {"x": X, "y": Y}, rng=np.random.default_rng(1)).evidence
    assert laplace.method == "the Laplace approximation"
    assert "one sample at a time" in laplace.reason
    assert abs(laplace.log_z - fitted.evidence.log_z) < 4 * fitted.evidence.error + 0.1


def test_what_is_written_is_strict_json(fitted):
    json.dumps(fit_json(fitted), allow_nan=False)


def test_too_few_readings_are_refused():
    with pytest.raises(ParameterError, match="12 or more"):
        fit_simulator(line(), {"x": X[:5], "y": Y[:5]}, rng=np.random.default_rng(1))
