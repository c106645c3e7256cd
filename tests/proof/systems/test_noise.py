"""Noise of other kinds is as plain as was asked for, and is what it is called."""

import numpy as np
import pytest

from probewise.proof.systems.cases import KINDS, OTHER_NOISE, draw_system, noise_of_size

DRAWN = draw_system(KINDS[3], rng=np.random.default_rng(4))
CLEAN = DRAWN.true_system.readings


def _noise(name, wanted=12.0, seed=0):
    return noise_of_size(name, wanted, CLEAN, DRAWN.diagnosed_table, 0.03, rng=np.random.default_rng(seed))


@pytest.mark.parametrize("name", OTHER_NOISE)
def test_every_kind_of_noise_is_drawn_about_the_readings(name):
    y = _noise(name).draw(CLEAN, DRAWN.diagnosed_table, np.random.default_rng(1))
    assert y.shape == CLEAN.shape
    assert np.median(np.abs(y - CLEAN)) < 10 * 0.03


def test_correlated_noise_gains_what_its_pairs_tell():
    noise = _noise("correlated_noise")
    pairs = len(CLEAN) - len(DRAWN.diagnosed_table.rows_by_run)
    assert -pairs * np.log(1 - noise.parameters["rho"] ** 2) == pytest.approx(144.0)
    rng = np.random.default_rng(2)
    own = [noise.draw(CLEAN, DRAWN.diagnosed_table, rng) - CLEAN for _ in range(60)]
    rows = DRAWN.diagnosed_table.rows_by_run[0]
    found = np.mean([np.corrcoef(e[rows[:-1]], e[rows[1:]])[0, 1] for e in own])
    assert found == pytest.approx(noise.parameters["rho"], abs=0.06)


def test_signal_dependent_noise_gains_its_mean_log_likelihood():
    """The mean gain of the true law over the best constant sd, over many drawings."""
    noise = _noise("signal_dependent_noise")
    share = (CLEAN - CLEAN.min()) / np.ptp(CLEAN)
    sd = 0.03 * np.sqrt(1 + noise.parameters["ratio"] * share)
    flat = np.sqrt(np.mean(sd**2))
    rng = np.random.default_rng(3)
    gains = []
    for _ in range(400):
        e = noise.draw(CLEAN, DRAWN.diagnosed_table, rng) - CLEAN
        gains.append(np.sum(-np.log(sd / flat) - 0.5 * (e / sd) ** 2 + 0.5 * (e / flat) ** 2))
    assert np.mean(gains) == pytest.approx(72.0, rel=0.05)


def test_a_walk_goes_on_from_run_to_run():
    noise = _noise("random_walk")
    q = noise.parameters["sd_per_row"]
    own = [noise.draw(CLEAN, DRAWN.diagnosed_table, np.random.default_rng(k))[-1] - CLEAN[-1] for k in range(200)]
    assert np.std(own) == pytest.approx(np.sqrt(len(CLEAN) * q**2 + 0.03**2), rel=0.15)


def test_rounding_is_declared():
    assert _noise("quantised").step == pytest.approx(0.05)


@pytest.mark.parametrize("name", ["random_walk", "signal_dependent_noise", "noise_per_run"])
def test_the_size_of_a_noise_is_that_which_was_asked_for_or_what_its_largest_strength_has(name):
    """At the limit of its strength, more makes no difference, and the recorded size is the same."""
    assert _noise(name, wanted=6.0).size_lambda == 6.0
    most, more = _noise(name, wanted=500.0), _noise(name, wanted=1000.0)
    assert most.parameters == more.parameters
    assert most.size_lambda == more.size_lambda
    assert 6.0 < most.size_lambda < 500.0


def test_the_recorded_size_of_noise_per_run_at_its_limit_is_its_mean_gain():
    """Closed form: n ln(mean variance) - sum ln(variance) is lambda squared."""
    noise = _noise("noise_per_run", wanted=1000.0)
    variances = np.array(noise.parameters["values"])[DRAWN.diagnosed_table.run] ** 2
    gain = len(variances) * np.log(variances.mean()) - np.log(variances).sum()
    assert noise.size_lambda == pytest.approx(np.sqrt(gain))
