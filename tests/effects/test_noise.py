"""Effects on the noise: what they do to single readings, and the statistics that show them."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.effects import Extent
from probewise.effects.noise import (
    correlated_noise,
    dropouts,
    lattice_step,
    outliers,
    quantisation,
    sd_of_estimated_lattice_step,
    signal_dependent_noise,
)
from probewise.effects.noise_distribution import log_density
from probewise.recordings import paper_plan
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels, FixedMixture

SD = 0.6
N = 408
PLAN = paper_plan()
CHAIN = Chain(
    FixedMixture([1.0], [[0.5, 1.5]], [[[16.0, 1.0], [1.0, 9.0]]]), FixedLevels(10, 60), KnownScene(PLAN.patterns)
)
NOISES = {
    "correlated_noise": (correlated_noise(), [0.5]),
    "signal_dependent_noise": (signal_dependent_noise(), [4.0]),
    "outliers": (outliers(), [0.05, 8.0]),
    "dropouts": (dropouts(), [0.03, 12.5]),
    "quantisation": (quantisation(), [0.9]),
}


def level_of(name):
    effect, values = NOISES[name]
    return CHAIN.with_effects(effect).noise_parameters(np.array([values]), PLAN, np.full((1, 1), SD))


def draw_readings(level, predicted, *, rng):
    """Draw readings of one scan, (n_samples, n_points): AR(1) noise, outliers, lost readings, then rounding."""
    noise = rng.standard_normal(predicted.shape)
    for k in range(1, noise.shape[1]):
        noise[:, k] = level.rho[:, 0] * noise[:, k - 1] + np.sqrt(1 - level.rho[:, 0] ** 2) * noise[:, k]
    noise *= np.where(rng.random(predicted.shape) < level.wide_share, level.wide_times, 1.0)
    readings = np.where(rng.random(predicted.shape) < level.lost_share, level.lost_value, predicted + level.sd * noise)
    step = np.where(level.step > 0, level.step, 1.0)
    return np.where(level.step > 0, step * np.round(readings / step), readings)


@pytest.mark.parametrize("name", NOISES)
def test_draws_follow_the_density(name):
    """Shares of many draws in bins against the density summed over them; one reading on white, others on the edge."""
    level = level_of(name)
    rows = np.array([0, 51, 99])
    level = replace(level, sd=np.broadcast_to(level.sd, (1, N))[:, rows])
    predicted = np.array([[10.0, 35.0, 60.0]])
    n_draws = 40_000
    drawn = draw_readings(level, np.repeat(predicted, n_draws, axis=0), rng=np.random.default_rng(4))
    step = float(level.step[0, 0]) or 0.01
    fine = step * np.arange(0, round(72 / step) + 1)
    density = np.exp(np.stack([log_density(level, np.full(3, x), predicted)[0] for x in fine]))
    bins = step * (np.arange(0, round(72 / step), max(round(0.5 / step), 1)) - 0.5)
    for k in range(3):
        found = np.histogram(drawn[:, k], bins)[0] / n_draws
        wanted = np.histogram(fine, bins, weights=density[:, k] * step)[0]
        if name == "dropouts":  # a point mass, narrower than the grid of this test
            at = np.digitize(12.5, bins) - 1
            assert found[at] == pytest.approx(0.03, abs=0.004 + (0.02 if k == 0 else 0))
            found, wanted = np.delete(found, at), np.delete(wanted, at)
        np.testing.assert_allclose(found, wanted, atol=0.012)


def test_noise_that_grows_with_the_light_does_so():
    level = level_of("signal_dependent_noise")
    np.testing.assert_allclose(level.sd[0, [0, 100]], [SD, SD * np.sqrt(5)], rtol=1e-3)


@pytest.mark.parametrize("digits", [2, 3, 6])
def test_a_lattice_shows_through_printing(digits):
    """Readings rounded to a step that is no round number, then printed: found to a few of its stated errors."""
    missed = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        readings = np.concatenate([rng.uniform(10, 60, 200), rng.choice([10.3, 59.2], 200) + rng.normal(0, 0.5, 200)])
        step = float(np.exp(rng.uniform(np.log(0.25), np.log(3.0))))
        printed = np.round(step * np.round(readings / step), digits)
        missed += abs(lattice_step(printed) - step) > 5 * sd_of_estimated_lattice_step(printed, step)
        assert lattice_step(np.round(readings, digits)) in (pytest.approx(10.0**-digits), 0.0)
    assert missed <= 1  # a step that happens to be nearly a round number
    whole = np.round(readings, digits)
    assert sd_of_estimated_lattice_step(whole, 10.0**-digits) <= 1e-6 * 10.0**-digits


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e9])
def test_the_bank_of_lost_readings_lies_within_their_prior_in_any_unit(unit):
    lost = dropouts.for_extent(Extent(10.0 * unit, 60.0 * unit, PLAN))
    values = lost.entries[:, 0, 1]
    assert np.isfinite(lost.prior.log_prob(lost.entries[:, 0])).all()
    np.testing.assert_allclose(np.unique(values), [9.50510 * unit, 60.49490 * unit])


def test_a_declared_lattice_is_no_effect():
    declared = replace(PLAN, instrumentation=replace(PLAN.instrumentation, step=1.0))
    assert quantisation.for_extent(Extent(10.0, 60.0, declared)) is None
