"""The time of a step beside another effect is known as well as the readings show it."""

import numpy as np
import pytest

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.samples import sample_model, weights_beside_other_effects
from probewise.diagnosis.search.search import search
from probewise.systems import RunTable, Simulator

_N, _AT, _SD = 150, 90, 0.08


@pytest.fixture(scope="module")
def prepared():
    """A straight line that leaves out a step, and the humidity, which hides the place of the step by half as much."""
    rng = np.random.default_rng(6)
    t, force = np.arange(float(_N)), 10 * rng.random(_N)
    humidity = 50 + 10 * rng.normal(size=_N)
    y = 2 + 0.5 * force + 0.3 * (t >= _AT) + 0.013 * (humidity - 50) + _SD * rng.normal(size=_N)
    table = RunTable({"t_s": t, "force": force, "humidity": humidity, "y": y}, time="t_s", run=None)
    simulator = Simulator(
        "y", "V", {"zero": (-10, 10), "slope": (0, 2)}, simulate=lambda p, u: p["zero"] + p["slope"] * u["force"],
        time="t_s",
    )  # fmt: skip
    return prepare_system(simulator, table), (t, force, humidity, y)


@pytest.fixture(scope="module")
def searched(prepared):
    return search(prepared[0])


def _best_of(searched, names):
    return max((fit for (_, own), fit in searched.evidences.fits.items() if own == names), key=lambda fit: fit.log_z)


def _exact_weights(columns):
    """Return the probability of each interval of the step by least squares with everything else: route two."""
    t, force, humidity, y = columns
    log_like = []
    for k in range(_N - 1):
        design = np.column_stack([np.ones(_N), force, humidity - humidity.mean(), t > k + 0.5])
        left = y - design @ np.linalg.lstsq(design, y)[0]
        log_like.append(-0.5 * (_N - 4) * np.log(np.sum(left**2)))
    log_like = np.array(log_like)
    return np.exp(log_like - log_like.max()) / np.exp(log_like - log_like.max()).sum()


def test_the_interval_of_a_step_is_as_probable_as_least_squares_with_all_effects_says(prepared, searched):
    ready, columns = prepared
    fit = _best_of(searched, ("offset_step", "sensitivity:humidity"))
    found = weights_beside_other_effects(fit.found, fit.law, ready.usable_rows, fit.weights)["offset_step"]
    exact = _exact_weights(columns)
    assert 0.5 * np.abs(found - exact).sum() < 0.1
    assert 0.5 * np.abs(fit.weights["offset_step"] - exact).sum() > 0.3  # as it was added, alone


def test_a_single_effect_keeps_its_weights(prepared, searched):
    fit = _best_of(searched, ("offset_step",))
    assert weights_beside_other_effects(fit.found, fit.law, prepared[0].usable_rows, fit.weights) is fit.weights


def test_samples_have_the_step_where_the_readings_have_it(prepared, searched):
    ready, columns = prepared
    fit = _best_of(searched, ("offset_step", "sensitivity:humidity"))
    evidence = next(iter(fit.evidence.values()))
    drawn = sample_model(
        fit.found, evidence, ready.recording, weights=fit.weights, rng=np.random.default_rng(0)
    ).effect_samples("offset_step")[:, -1]
    exact = _exact_weights(columns)
    assert np.mean(np.abs(drawn - _AT) < 5) > exact[_AT - 5 : _AT + 4].sum() - 0.1
