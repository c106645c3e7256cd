"""Noise of other kinds is as plain as was asked for, and is what it is called."""

import numpy as np
import pytest

from probewise.proof.systems.cases import KINDS, OTHER_NOISE, draw_system, make_noise

DRAWN = draw_system(KINDS[3], rng=np.random.default_rng(4))
CLEAN, ROWS, SD = DRAWN.true_system.readings, DRAWN.diagnosed_table, 0.03


def drawn(name, n, seed=0):
    """Return n draws of a noise, in sds, (n, n_points)."""
    noise, rng = make_noise(name, CLEAN, ROWS, SD, rng=np.random.default_rng(seed)), np.random.default_rng(2)
    return np.array([noise.draw(CLEAN, ROWS, rng) - CLEAN for _ in range(n)]) / SD


def gained(variances):
    """Return the expected gain in nats of the true variances over the best constant one, of which lambda^2 is twice."""
    return 0.5 * (len(variances) * np.log(variances.mean()) - np.log(variances).sum())


@pytest.mark.parametrize("name", OTHER_NOISE)
def test_every_kind_of_noise_is_drawn_about_the_readings(name):
    assert np.median(np.abs(drawn(name, 1))) < 10


def test_correlated_noise_gains_what_its_pairs_tell():
    rows = ROWS.rows_by_run[0]
    found = np.mean([np.corrcoef(e[rows[:-1]], e[rows[1:]])[0, 1] for e in drawn("correlated_noise", 60)])
    pairs = len(CLEAN) - len(ROWS.rows_by_run)
    assert found == pytest.approx(np.sqrt(1 - np.exp(-144.0 / pairs)), abs=0.06)


@pytest.mark.parametrize("name", ["signal_dependent_noise", "noise_per_run"])
def test_noise_of_several_variances_gains_as_an_effect_of_lambda_12_does(name):
    """The variances are those of many draws; chance adds half a nat a row over their number."""
    n = 4000
    assert gained(drawn(name, n).var(axis=0)) == pytest.approx(72.0 + 0.5 * len(CLEAN) / n, rel=0.05)


def test_a_walk_goes_on_from_run_to_run():
    """Its variance grows with the row, to a step's for each row; the gain is that of its spectrum."""
    q2 = drawn("random_walk", 400).var(axis=0) - 1
    assert np.polyfit(np.arange(len(q2)), q2, 1)[0] == pytest.approx(q2[-20:].mean() / len(q2), rel=0.2)


def test_rounding_is_declared():
    assert make_noise("quantised", CLEAN, ROWS, SD, rng=np.random.default_rng(0)).step == pytest.approx(0.05)
