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


@pytest.mark.parametrize("scale", [1.0, 1e-9])
def test_the_noise_is_in_the_unit_of_the_readings(scale):
    """And so small that nothing but the unit makes it so: readings in amperes may have noise of a picoampere."""
    simulator = Simulator(
        "y", "A", {"a": ("normal", 0, 3 * scale), "b": ("normal", 0, 3 * scale)},
        simulate=lambda p, data: p["a"] + p["b"] * data["x"], noise={"sd": 1e-4 * scale},
    )  # fmt: skip
    readings = scale * (1 + 2 * X + 1e-4 * np.random.default_rng(2).standard_normal(60))
    found = fit_simulator(simulator, {"x": X, "y": readings}, rng=np.random.default_rng(1)).fitted
    assert np.median(found.noise_sd) / scale == pytest.approx(1e-4, rel=0.3)


@pytest.mark.slow
def test_the_noise_of_rounded_readings_has_the_rounding_in_it_whichever_way_they_are_fitted():
    """Sd 0.1 and rounded to whole numbers: by quadrature 0.1 and 1 / sqrt(12) add up to 0.305."""
    x = np.linspace(-10.0, 10.0, 60)
    readings = np.round(1.0 + 2.0 * x + 0.1 * np.random.default_rng(3).standard_normal(60))
    found = {}
    for way in (
        lambda p, data: p["a"] + p["b"] * data["x"],
        lambda p, data: np.array([float(p["a"]) + float(p["b"]) * x for x in data["x"]]),
    ):
        given = line(simulate=way, noise={"sd": 0.1, "step": 1.0})
        fit = fit_simulator(given, {"x": x, "y": readings}, rng=np.random.default_rng(1))
        found[fit.evidence.method] = np.median(fit.fitted.noise_sd)
    assert found.keys() == {"nested sampling", "the Laplace approximation"}
    for sd in found.values():
        assert sd == pytest.approx(np.hypot(0.1, 1 / np.sqrt(12)), rel=0.1)


def test_what_is_written_is_strict_json(fitted):
    json.dumps(fit_json(fitted), allow_nan=False)


def test_too_few_readings_are_refused():
    with pytest.raises(ParameterError, match="12 or more"):
        fit_simulator(line(), {"x": X[:5], "y": Y[:5]}, rng=np.random.default_rng(1))
