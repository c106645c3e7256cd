"""Rounded normal noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import logsumexp
from scipy.stats import norm

from probewise.diagnosis import diagnose
from probewise.diagnosis.apparatus import PriorOdds
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.noise import NoiseLaw, NoiseModel, RoundedNormal, SdPrior, rough_sd
from probewise.diagnosis.search import noise_sd_about_given_null
from probewise.diagnosis.search.hypotheses import NoiseModels
from probewise.effects import VOCABULARY, Extent
from probewise.recordings import Recording, paper_plan
from probewise.sensor import Stage
from probewise.systems import Noise, Simulator, table_for
from probewise.world import concealed as hidden
from probewise.world.spots import Blob, gaussian_spot
from probewise.world.world import World

STEP, SIGMA = 4.0, 0.7


def rounded(noise_sd: float, seed: int, *concealed: hidden.Concealed) -> Recording:
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


@pytest.mark.parametrize("half", [0.8, 2.0, 6.0])
def test_pseudo_residuals_say_as_much_as_the_density_does(half):
    rng = np.random.default_rng(3)
    z = rng.normal(size=400_000) + half * rng.uniform(-1, 1, 400_000)
    flat, one = RoundedNormal(half, 1.0), np.ones(1)
    plain, moved = (flat.normal_pseudo_residuals((z + shift)[:, None], one)[:, 0] for shift in (0.0, 0.05))
    assert np.mean(moved - plain) == pytest.approx(0.05, rel=0.03)
    assert np.var(plain) == pytest.approx(1 / float(flat.fisher_information), rel=0.02)

    def squared_score(x: float) -> float:
        density = (norm.cdf(x + half) - norm.cdf(x - half)) / (2 * half)
        slope = (norm.pdf(x + half) - norm.pdf(x - half)) / (2 * half)
        return slope**2 / density

    wanted = quad(squared_score, -half - 7, half + 7, points=[-half, half], limit=200)[0]
    assert float(flat.fisher_information) == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("declared", [False, True])
@pytest.mark.parametrize(("noise_sd", "coarse"), [(0.4, True), (3.0, False)])
def test_rounding_that_hides_the_noise_is_in_its_law_declared_or_not(noise_sd, coarse, declared):
    recording = rounded(noise_sd, 1)
    found = noises(as_declared(recording) if declared else recording)
    assert found.certain == (() if declared else ("quantisation",))
    for names, model in found.models.items():
        laws = model.nodes_for_predictions(recording.readings).laws
        assert all(bool(law.flat) == (coarse and names == found.certain) for law in laws)


@pytest.mark.parametrize("order", ["sorted", "shuffled"])
@pytest.mark.parametrize("spread", [1.0, 10.0])
def test_rounding_is_found_in_whatever_order_readings_are_taken(order, spread):
    """Successive readings may differ by the signal; of readings with declared sds, the most exact show the rounding."""
    rng, n = np.random.default_rng(1), 100
    x = rng.uniform(-1, 1, n)
    x = np.sort(x) if order == "sorted" else x
    sd = np.where(rng.random(n) < 0.5, 0.05, 0.05 * spread)
    line = Simulator(
        "y",
        "V",
        {"a": (-5, 5), "b": (-5, 5)},
        simulate=lambda p, u: p["a"] + p["b"] * u["x"],
        time="t",
        noise=Noise(sd="sd"),
    )
    readings = 0.1 * np.round((1 + 2 * x + sd * rng.standard_normal(n)) / 0.1)
    prepared = prepare_system(line, table_for(line, {"t": np.arange(float(n)), "x": x, "sd": sd, "y": readings}))
    effects = {"quantisation": prepared.effects["quantisation"]}
    prior, about = PriorOdds.for_effects(effects), noise_sd_about_given_null(prepared)
    found = NoiseModels(prepared.recording, effects, prior, about)
    assert found.certain == ("quantisation",)
    # Beside unequal sds the floor of the sd stands for the rounding.
    assert found.models["quantisation",].rounding == pytest.approx(0.1 if spread == 1.0 else 0.0)


@pytest.mark.parametrize("noise_sd", [0.5, 1.0, 3.0])
def test_the_noise_of_rounded_readings_is_told_without_a_model(noise_sd):
    """Rounding and all; the median of few values would be one of them. Less noise than half a step is told as less."""
    rng = np.random.default_rng(5)
    plan = paper_plan()
    mean = 20 + 0.15 * np.arange(len(plan))
    readings = Recording(plan, np.round(mean + noise_sd * rng.standard_normal(len(plan))))
    wanted = np.sqrt(noise_sd**2 + 1 / 12 + 1 / 72)  # rounding, and what is the same spread over a step
    assert rough_sd(readings) == pytest.approx(wanted, rel=0.2)


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
