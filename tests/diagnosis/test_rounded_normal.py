"""Rounded normal noise."""

import dataclasses

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

from probewise.diagnosis import diagnose
from probewise.diagnosis.apparatus import PriorOdds
from probewise.diagnosis.noise import NoiseLaw, NoiseModel, SdPrior
from probewise.diagnosis.search.hypotheses import NoiseModels
from probewise.effects import VOCABULARY, Extent
from probewise.recordings import Recording, paper_plan
from probewise.sensor import Stage
from probewise.world.spots import Blob, gaussian_spot
from probewise.world.world import World

STEP, SIGMA = 4.0, 0.7


def rounded(noise_sd: float, seed: int, *concealed) -> Recording:
    plan = paper_plan()
    spot = gaussian_spot([Blob(1.0, (1.5, 2.5), (6.0, 8.0), 0.2)], pixel_mm=1.0)
    mean = World(spot, concealed=concealed).expected_readings(plan)
    readings = mean + noise_sd * np.random.default_rng(seed).standard_normal(len(plan))
    return Recording(plan, STEP * np.round(readings / STEP))


def as_declared(recording: Recording) -> Recording:
    instrumentation = dataclasses.replace(recording.plan.instrumentation, step=STEP)
    return dataclasses.replace(recording, plan=dataclasses.replace(recording.plan, instrumentation=instrumentation))


def noises(recording: Recording, **more: SdPrior) -> NoiseModels:
    extent = Extent.of(recording)
    built = {name: kind.for_extent(extent) for name, kind in VOCABULARY.items() if kind.stage is Stage.NOISE}
    effects = {name: effect for name, effect in built.items() if effect is not None}
    return NoiseModels(recording, effects, PriorOdds.for_effects(effects), **more)


def log_cells(residuals: np.ndarray, sd: float) -> np.ndarray:
    """Return the log probability of each reading's cell over the step, from the tail in which it is exact."""
    near = -np.abs(residuals)
    cell = norm.cdf((near + STEP / 2) / sd) - norm.cdf((near - STEP / 2) / sd)
    return np.log(np.maximum(cell, 1e-300) / STEP)


def test_a_rounded_reading_has_the_probability_of_its_cell():
    lost = np.arange(60) % 10 == 4
    law = NoiseLaw(np.ones(60), np.zeros(60), lost, flat=0.5 * STEP / SIGMA, sigma=SIGMA)
    residuals = np.linspace(-1.0, 1.0, 60) * (STEP / 2 + 2 * SIGMA)
    whitened = law(residuals)[:, None]
    found = -law.minus_log_likelihood(whitened, law.likeliest_sigma(whitened))[0] - law.half_log_det()
    wanted = log_cells(residuals, SIGMA)[~lost].sum()
    assert found - 0.5 * law.n_kept * np.log(2 * np.pi) == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("declared", [False, True])
@pytest.mark.parametrize(("noise_sd", "coarse"), [(0.4, True), (3.0, False)])
def test_rounding_that_hides_the_noise_is_in_its_law_declared_or_not(noise_sd, coarse, declared):
    recording = rounded(noise_sd, 1)
    found = noises(as_declared(recording) if declared else recording)
    assert found.certain == (() if declared else ("quantisation",))
    for names, model in found.models.items():
        laws = model.nodes_for_predictions(recording.readings).laws
        assert all(bool(law.flat) == (coarse and names == found.certain) for law in laws)


@pytest.mark.parametrize("noise_sd", [0.3, 0.9, 1.6, 30.0])
def test_the_noise_beside_rounding_is_integrated_out(noise_sd):
    """Route two: a fine grid of its logarithm, each reading the probability of its cell.

    The largest is what may be left where something is missing from the mean, many steps of it.
    """
    rng = np.random.default_rng(7)
    plan = paper_plan()
    mean = 50 + 35 * np.sin(np.arange(len(plan)))
    recording = Recording(
        plan, STEP * np.round((mean + noise_sd * rng.standard_normal(len(plan))) / STEP)
    ).without_declared_range()
    nodes = NoiseModel((), recording, rounding=STEP).nodes_for_predictions(mean)
    off = (recording.readings - mean)[:, None]
    each = np.array([-law.minus_log_likelihood(off, law.likeliest_sigma(off))[0] for law in nodes.laws])

    log_sigma = np.linspace(np.log(STEP / 30), np.log(30 * STEP), 4001)
    near = -np.abs(off)  # where a difference of cumulatives is exact
    cell = norm.cdf((near + STEP / 2) / np.exp(log_sigma)) - norm.cdf((near - STEP / 2) / np.exp(log_sigma))
    grid = np.log(np.maximum(cell, 1e-300) / STEP).sum(axis=0) + 0.5 * len(plan) * np.log(2 * np.pi)
    wanted = logsumexp(grid) + np.log(log_sigma[1] - log_sigma[0])
    assert logsumexp(each + nodes.log_weights) == pytest.approx(wanted, abs=0.1)


@pytest.mark.parametrize("declared", [True, False])
def test_rounding_alone_is_no_other_noise_than_at_the_calibration(declared):
    """The readings of the calibration may have been rounded as coarsely, or not: variances add."""
    recording = as_declared(rounded(0.7, 1)) if declared else rounded(0.7, 1)
    prior = noises(recording, sd_prior=SdPrior(np.log(0.7), 0.05)).sd_prior
    sds = np.array([0.7, 1.0, np.hypot(0.7, STEP / np.sqrt(12)), 0.4, 2.0])
    same, changed = dataclasses.replace(prior, log_changed=0.0).log_odds(np.stack([np.log(sds), np.full(5, 1 / 800)]))
    np.testing.assert_allclose(same[:3], same[0])
    assert (same[:3] > changed[:3]).all()
    assert (same[3:] < changed[3:]).all()


@pytest.mark.slow
@pytest.mark.parametrize("noise_sd", [0.7])
def test_coarse_rounding_is_all_that_is_found_in_coarsely_rounded_readings(noise_sd):
    """Where nine readings of ten say the same, what rounding leaves follows the place, and was taken for physics."""
    found = diagnose(rounded(noise_sd, 1), rng=np.random.default_rng(0))
    assert (found.verdict, found.combination) == ("noise", ("quantisation",))
    assert "0.0 nats" not in found.summary()
    assert "all readings are multiples of one step" in found.to_html()
    assert found.p_value > 0.01  # one test; 0.09 and more in twenty others
    sigma = np.sqrt(np.mean(found.repaired.noise_sd**2))
    assert sigma == pytest.approx(noise_sd, rel=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("noise_sd", [0.9, 1.4])
def test_a_step_that_is_declared_is_no_effect_and_what_it_leaves_no_physics(noise_sd):
    found = diagnose(as_declared(rounded(noise_sd, 1)), rng=np.random.default_rng(0))
    assert (found.verdict, found.noise.model) == ("clean", "white")
    assert found.p_value > 0.01  # one test each
    sigma = np.sqrt(np.mean(found.repaired.noise_sd**2))
    assert sigma == pytest.approx(np.hypot(noise_sd, STEP / np.sqrt(12)), rel=0.15)
