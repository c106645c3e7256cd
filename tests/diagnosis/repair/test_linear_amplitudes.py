"""Values of amplitudes about 0, where the coordinate of a heavy-tailed prior is far from linear in them."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import laplace_evidence
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.linear_posterior import LinearAmplitudes
from probewise.diagnosis.noise_law import white_noise
from probewise.diagnosis.noise_models import NoiseModel
from probewise.diagnosis.samples import sample_model
from probewise.systems import RunTable, Simulator

N, SD = 60, 0.1
RUN = np.repeat(np.arange(6.0), N // 6)
DRIVE = np.tile(np.linspace(0.2, 2.0, N // 6), 6)


def drawn(gains, seed):
    """Samples of one gain per run, about a fit under white noise, and what least squares says of each run."""
    rng = np.random.default_rng(seed)
    y = 2.0 * DRIVE * (1 + np.asarray(gains)[RUN.astype(int)]) + SD * rng.normal(size=N)
    table = RunTable({"run": RUN, "drive": DRIVE, "y": y}, run="run")
    simulator = Simulator("y", "V", {"zero": (-1, 1)}, simulate=lambda p, u: p["zero"] + 2.0 * u["drive"], run="run")
    prepared = prepare_system(simulator, table)
    (each_its_own,) = prepared.effects["gain_per_run"].alternatives
    model = Model(prepared.null, (each_its_own,), prepared.recording.plan)
    found = fit(model, prepared.recording, np.zeros(model.n_params), white_noise(N))
    evidence = laplace_evidence(found, NoiseModel((), prepared.recording, least_sd=1e-3))
    weights = {"gain_per_run": np.ones(1)}
    samples = sample_model(found, evidence, prepared.recording, weights=weights, rng=rng, annealed=False)
    return found, samples.effect_samples("gain_per_run"), y


def test_a_value_that_readings_fix_about_zero_is_as_certain_as_the_others():
    """By numbers: the heavy-tailed prior times the normal likelihood of one run; the zero hardly matters."""
    found, values, y = drawn([0.6, -0.5, 0.4, 0.0, -0.45, 0.5], seed=1)
    (effect,) = found.model.effects
    prior = effect.prior.marginals["values[3]"]
    mine, zero = RUN == 3, found.model.theta(found.z[None, :])[0, 0]
    signal = (2.0 * DRIVE + zero)[mine]
    best, sd = signal @ (y[mine] - signal) / (signal @ signal), found.sd / np.sqrt(signal @ signal)
    grid = np.linspace(best - 8 * sd, best + 8 * sd, 4001)
    density = np.exp(prior.log_prob(grid) - 0.5 * ((grid - best) / sd) ** 2)
    density /= density.sum()
    mean = grid @ density
    expected = np.sqrt((grid - mean) ** 2 @ density)
    assert values[:, 3].std() == pytest.approx(expected, rel=0.2)
    assert values[:, 3].mean() == pytest.approx(mean, abs=0.25 * expected)
    assert 0.5 < values[:, 3].std() / values[:, 0].std() < 1.5


def test_amplitudes_that_are_well_known_are_left_to_their_coordinates():
    found, _, _ = drawn([0.6, -0.5, 0.4, 0.7, -0.45, 0.5], seed=2)
    slopes, residuals = found.slopes / found.sd, found.residuals / found.sd
    assert LinearAmplitudes.of(found, 1000 * slopes, residuals) is None


@pytest.mark.parametrize("annealed", [True, False])
def test_values_of_one_size_leave_open_what_they_have_in_common(annealed):
    """By numbers: a mean with a wide prior and values of one sd; given the sd, all are jointly normal."""
    rng = np.random.default_rng(4)
    y = np.array([0.4, -0.5, 0.05, 0.1, -0.3, 0.6])[RUN.astype(int)] + SD * rng.normal(size=N)
    table = RunTable({"run": RUN, "drive": DRIVE, "y": y}, run="run")
    simulator = Simulator("y", "V", {"mean": (-50, 50)}, simulate=lambda p, u: p["mean"] + 0 * u["drive"], run="run")
    prepared = prepare_system(simulator, table)
    effect = replace(prepared.effects["offset_per_run"], alternatives=())
    model = Model(prepared.null, (effect,), prepared.recording.plan)
    found = fit(model, prepared.recording, np.zeros(model.n_params), white_noise(N))
    evidence = laplace_evidence(found, NoiseModel((), prepared.recording, least_sd=1e-3))
    samples = sample_model(
        found, evidence, prepared.recording, weights={"offset_per_run": np.ones(1)}, rng=rng, annealed=annealed
    ).effect_samples("offset_per_run")
    design = np.concatenate([np.ones((N, 1)), RUN[:, None] == np.arange(6)], axis=1) / found.sd
    each = []
    for sd in effect.prior.component_sds:
        precision = np.diag([0.0] + [sd**-2] * 6)  # the mean's prior is flat
        covariance = np.linalg.inv(design.T @ design + precision)
        mean = covariance @ design.T @ y / found.sd
        log_weight = 0.5 * np.linalg.slogdet(covariance)[1] - 6 * np.log(sd)
        log_weight += 0.5 * mean @ np.linalg.solve(covariance, mean)
        each.append((log_weight, mean[1:], covariance[1:, 1:]))
    weights = np.exp([w for w, _, _ in each] - max(w for w, _, _ in each))
    weights /= weights.sum()
    mean = sum(w * m for w, (_, m, _) in zip(weights, each, strict=True))
    spread = sum(w * (c + np.outer(m - mean, m - mean)) for w, (_, m, c) in zip(weights, each, strict=True))
    np.testing.assert_allclose(samples.mean(axis=0), mean, atol=0.2 * np.sqrt(spread[0, 0]))
    common = np.sqrt(spread.mean())
    assert common > 4 * SD / np.sqrt(N)  # far more than the readings would leave open without the values
    assert samples.mean(axis=1).std() == pytest.approx(common, rel=0.2)
