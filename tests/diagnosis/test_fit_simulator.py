"""Fit of a simulator without a diagnosis."""

from __future__ import annotations

import json

import numpy as np
import pytest

from probewise.diagnosis import fit_json, fit_simulator
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.errors import ParameterError
from probewise.systems import Noise, Simulator, table_for

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


X_IN_CONFLICT = np.linspace(1, 20, 40)
SLOPE, SD = 1.8, 1.0


def _notes(prior, *, slope=SLOPE, seed=3):
    rng = np.random.default_rng(seed)
    simulator = Simulator(
        "strain_ue", "ue", {"per_n": prior}, simulate=lambda p, data: p["per_n"] * data["pull_n"], noise=Noise(sd=SD)
    )
    table = {
        "pull_n": X_IN_CONFLICT,
        "strain_ue": slope * X_IN_CONFLICT + rng.normal(0, SD, len(X_IN_CONFLICT)),
    }
    prepared = prepare_system(simulator, table_for(simulator, table), with_effects=False)
    return [note for note in prepared.recording.notes if "prior" in note]


@pytest.mark.parametrize(
    ("prior", "words"),
    [
        ((0, 1), "per_n is at the upper end of its prior, uniform 0 to 1, but the readings ask for a larger value"),
        ((3, 9), "per_n is at the lower end of its prior, uniform 3 to 9, but the readings ask for a smaller value"),
        (("log", 0.1, 1), "upper end"),
        (("normal", 1.0, 0.1), "sds above the mean of its prior, normal 1 ± 0.1"),
    ],
)
def test_a_prior_that_excludes_what_the_readings_say_is_told(prior, words):
    (note,) = _notes(prior)
    assert words in note


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("prior", "slope"), [((0, 100), 0.1), ((0, 1.8), SLOPE), (("normal", 1.6, 0.1), SLOPE), ((0, 5), 0.0)]
)
def test_a_wide_prior_and_one_that_ends_at_the_truth_are_not(prior, slope, seed):
    """By chance a best value is four sds beyond an end at the truth in 3e-5 of recordings, by far the most of these."""
    assert not _notes(prior, slope=slope, seed=seed)


@pytest.mark.parametrize(("declared", "told"), [(0.5, True), (2.0, True), (SD, False), (None, False)])
def test_a_noise_that_is_not_as_it_was_declared_is_told(declared, told):
    """Of 400 readings the sd is known to a thirtieth."""
    rng, x = np.random.default_rng(8), np.linspace(1, 20, 400)
    simulator = Simulator(
        "strain_ue",
        "ue",
        {"per_n": (0, 5)},
        simulate=lambda p, data: p["per_n"] * data["pull_n"],
        noise={"sd": declared},
    )
    table = {"pull_n": x, "strain_ue": SLOPE * x + rng.normal(0, SD, len(x))}
    notes = fit_simulator(simulator, table, rng=rng).recording.notes
    assert sum("the noise sd of a reading is " in note and "was declared" in note for note in notes) == told
