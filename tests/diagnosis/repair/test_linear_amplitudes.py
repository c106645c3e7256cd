"""Values of amplitudes about 0, where the coordinate of a heavy-tailed prior is far from linear in them."""

import numpy as np
import pytest

from probewise.diagnosis.evidence.laplace import laplace_evidence
from probewise.diagnosis.fitting.fit import Model, fit
from probewise.diagnosis.noise.law import white_noise
from probewise.diagnosis.noise.models import NoiseModel
from probewise.diagnosis.repair.linear_amplitudes import LinearAmplitudes
from probewise.diagnosis.repair.samples import sample_model
from probewise.diagnosis.system.diagnose import prepare_system
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
    assert LinearAmplitudes.of(found, np.full(len(found.z), 0.1)) is None
    some = LinearAmplitudes.of(found, np.where(np.arange(len(found.z)) == 4, 0.5, 0.1))
    assert some.at == (4,)
    step = 1e-6
    there = found.model.theta(np.stack([found.z, found.z + step * (np.arange(len(found.z)) == 4)]))[:, 4]
    assert some.values[0] == pytest.approx(there[0])
    assert some.per_z[0] == pytest.approx((there[1] - there[0]) / step, rel=1e-4)
