"""What a repair gains where the zero wanders: each model is told of the walk by the other readings."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from probewise.diagnosis import diagnose_system, repaired_of
from probewise.systems import Simulator, predict_system

_N, _SD, _STEP, _WAVE = 150, 0.1, 0.05, 0.25


def _covariance(step, sd):
    at = np.arange(_N)
    return step**2 * (1 + np.minimum.outer(at, at)) + sd**2 * np.eye(_N)


def _recorded():
    rng, t = np.random.default_rng(3), np.arange(_N, dtype=float)
    walk = _STEP * np.cumsum(rng.standard_normal(_N))
    return t, 20 + 0.01 * t + _WAVE * np.sin(0.6 * t + 1) + walk + _SD * rng.standard_normal(_N)


@pytest.fixture(scope="module")
def diagnosis():
    t, y = _recorded()
    line = Simulator(
        "y", "degC", {"a": (0, 50), "b": (-1, 1)}, simulate=lambda p, u: p["a"] + p["b"] * u["t_s"], time="t_s",
        vectorized=True,
    )  # fmt: skip
    return diagnose_system(line, {"t_s": t, "y": y}, rng=np.random.default_rng(1))


def _log_density_given_the_rest(readings, columns):
    """Return the mean, over readings, of log densities of a fifth given the rest, of a linear model with wide priors.

    The step of its walk and the sd of its noise are the likeliest.
    """

    def log_density(log_noise, rows):
        every = 1e4 * columns @ columns.T + _covariance(*np.exp(log_noise))
        return multivariate_normal(np.zeros(len(rows)), every[np.ix_(rows, rows)]).logpdf(readings[rows])

    rows = np.arange(_N)
    noise = minimize(lambda x: -log_density(x, rows), np.log([_STEP, _SD]), method="Nelder-Mead").x
    parts = [np.setdiff1d(rows, part) for part in np.array_split(rows, 5)]
    return sum(log_density(noise, rows) - log_density(noise, kept) for kept in parts) / _N


def test_the_gain_on_held_out_parts_is_that_of_the_conditional_densities(diagnosis):
    """It was 0.54 instead of 0.37 where no reading beside them told of the walk, and below 0 for longer walks."""
    t, y = _recorded()
    assert diagnosis.combination == ("interference", "random_walk")
    line = np.stack([np.ones(_N), t / _N], axis=1)
    right = np.concatenate([line, np.sin(0.6 * t)[:, None], np.cos(0.6 * t)[:, None]], axis=1)
    expected = _log_density_given_the_rest(y, right) - _log_density_given_the_rest(y, line)
    gain = diagnosis.improvement
    assert gain.heldout_log_density_per_reading == pytest.approx(expected, rel=0.1)
    assert gain.heldout_log_density_per_reading > 4 * gain.heldout_sd


def test_residuals_count_from_the_walk_and_the_lines_contain_it(diagnosis):
    y = _recorded()[1]
    gain, repair = diagnosis.improvement, diagnosis.repair
    assert 0.7 * _SD < gain.rms_after < 1.1 * _SD < gain.rms_before
    for shown, rms in ((repair.before, gain.rms_before), (repair.after, gain.rms_after)):
        assert shown.has_walk
        np.testing.assert_allclose(shown.readings_with_walk + shown.residuals, y)
        assert np.sqrt(np.mean(shown.residuals**2)) == pytest.approx(rms)
        assert abs(shown.residuals.mean()) < _SD / 2


def test_rows_after_the_recording_have_the_whole_walk_in_their_sd(diagnosis):
    """As the guide says: predictions look at no reading, and the walk counts from the recording's first row."""
    t = np.arange(_N, _N + 30, dtype=float)
    later = predict_system(repaired_of(diagnosis), {"t_s": t}, rng=np.random.default_rng(2))
    samples = diagnosis.repaired
    step = samples.noise_sd * samples.effect_samples("random_walk")[:, 0]
    law = np.var(samples.chain.predict(samples.theta, diagnosis.recording.plan)[:, -1])
    expected = np.sqrt(np.mean(samples.noise_sd**2) + np.mean(step**2) * (t + 1) + law)
    np.testing.assert_allclose(later.sd, expected, rtol=0.1)
