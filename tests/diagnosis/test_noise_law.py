"""Noise: heavy tails, lost and outlying readings, runs one after the other and interleaved."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.special import gammaln, logsumexp
from scipy.stats import betabinom, norm

from probewise.diagnosis import diagnose
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import held_out_gain, laplace_evidence
from probewise.diagnosis.fit import Fit, Model, fit
from probewise.diagnosis.locate import Covariate, window_columns
from probewise.diagnosis.noise import (
    NoiseLaw,
    NoiseModel,
    log_prior_of_lost_value,
    n_rows_since_previous_usable,
    order_by_scan,
    previous_usable,
    white_noise,
)
from probewise.diagnosis.outlying import clustering_log_bayes_factors, outlier_probabilities
from probewise.effects.noise import dropouts, noise_of_runs, outliers
from probewise.effects.noise_distribution import FittedReadings
from probewise.recordings import Recording, paper_plan, two_way_plan
from probewise.systems import RunTable, Simulator, as_recording, table_for
from probewise.world.spots import Blob, gaussian_spot
from probewise.world.world import World

PLAN = paper_plan()
N = len(PLAN)
SD = 0.6
MEAN = 35.0 + 25.0 * np.tanh(PLAN.x_mm / 8)


def heavy(share: float, times: float, n: int = 50) -> NoiseLaw:
    return NoiseLaw(np.ones(n), np.zeros(n), np.zeros(n, dtype=np.bool_), share, times)


def found_with(noise: np.ndarray, slope: np.ndarray | None = None) -> tuple[Fit, Recording]:
    """Make a fit of one parameter at its prior's centre."""
    slopes = np.zeros((N, 1)) if slope is None else slope[:, None]
    model = cast(Any, SimpleNamespace(sensor=SimpleNamespace(has_exchangeable_gaussians=False)))
    return Fit(model, np.zeros(1), MEAN, noise, slopes, SD, 0.0), Recording(PLAN, MEAN + noise)


def log_mixture(z: np.ndarray, share: float, times: float) -> np.ndarray:
    return np.logaddexp(math.log1p(-share) + norm.logpdf(z), math.log(share) + norm.logpdf(z, scale=times))


@pytest.mark.parametrize(("share", "times"), [(0.02, 8.0), (0.2, 2.5)])
def test_the_misfit_is_minus_the_log_density(share, times):
    z = np.random.default_rng(0).normal(size=(50, 3)) * [1.0, 2.0, 5.0]
    sigma = np.array([1.0, 1.5, 2.0])
    found = heavy(share, times).minus_log_likelihood(z, sigma) + 25 * math.log(2 * math.pi)
    wanted = -np.sum(log_mixture(z / sigma, share, times) - np.log(sigma), axis=0)
    np.testing.assert_allclose(found, wanted)


@pytest.mark.parametrize(("share", "times"), [(0.02, 8.0), (0.2, 2.5), (0.05, 30.0)])
def test_the_scale_of_heavy_tailed_noise_is_at_the_peak_of_its_likelihood(share, times):
    """Also of noise whose tail is another; from a scale 1 % off it comes four times as close."""
    rng, law = np.random.default_rng(4), heavy(share, times)
    z = rng.normal(size=(50, 40)) * np.where(rng.random((50, 40)) < 0.1, 6.0, 1.0)
    sigma = law.likeliest_sigma(z)
    best = law.minus_log_likelihood(z, sigma)
    for factor in (0.99, 1.01):
        assert (law.minus_log_likelihood(z, factor * sigma) > best).all()
        again = law.whitened_density.likeliest_sigma(z, 50, start=factor * sigma)
        np.testing.assert_allclose(again, sigma, rtol=0.0025)


def test_readings_lost_to_one_value_are_no_wide_ones():
    rng = np.random.default_rng(5)
    noise = SD * rng.normal(size=N)
    lost = np.array([30, 90, 200, 310])
    noise[lost] = -MEAN[lost]
    found, recording = found_with(noise)
    log_z = {
        e.name: laplace_evidence(found, NoiseModel((e,), recording, least_sd=1e-6)).log_z
        for e in (dropouts(), outliers())
    }
    plain = laplace_evidence(found, NoiseModel((), recording, least_sd=1e-6)).log_z
    assert log_z["dropouts"] > log_z["outliers"] + 3 > plain + 50
    law = laplace_evidence(found, NoiseModel((dropouts(),), recording, least_sd=1e-6)).likeliest_law
    np.testing.assert_array_equal(np.flatnonzero(law.lost), lost)


def test_the_prior_of_what_is_lost_to_sums_to_one():
    """Of a hundred cells of the range two are its ends, each of them likely."""
    others = 98 * math.exp(log_prior_of_lost_value(37.0, 100.0, (0.0, 100.0)))
    assert others + 2 * math.exp(log_prior_of_lost_value(100.0, 100.0, (0.0, 100.0))) == pytest.approx(1.0)
    assert log_prior_of_lost_value(100.0, 100.0, ()) == -math.log(100.0)


@pytest.mark.slow
@pytest.mark.parametrize("declared", [True, False])
def test_lost_readings_are_found_among_rounded_ones(declared):
    """Where most readings are just as rounded predictions are, their spread is nothing, and still not all are far."""
    plan = two_way_plan()
    instrumentation = replace(plan.instrumentation, step=1.0 if declared else None)
    plan = replace(plan, instrumentation=instrumentation)
    world = World(gaussian_spot([Blob(1.0, (0.4, -0.3), (5.0, 3.5), 0.3)], pixel_mm=0.5))
    rng = np.random.default_rng(3)
    readings = np.round(world.expected_readings(plan) + 0.45 * rng.standard_normal(len(plan)))
    readings[rng.choice(len(plan), 16, replace=False)] = 3.0
    found = diagnose(Recording(plan, readings), rng=rng)
    assert found.verdict == "noise"
    assert "dropouts" in found.combination
    lost = next(effect for effect in found.effects if effect.name == "dropouts")
    assert lost.parameters[1].mean == pytest.approx(3.0, abs=0.01)


def test_the_evidence_of_noise_per_run_is_that_of_brute_force():
    """Route two: values of the runs drawn from their prior, the overall sd integrated in closed form."""
    rng = np.random.default_rng(0)
    counts = (30, 40, 20)
    run = np.repeat([0, 1, 2], counts)
    residuals = rng.standard_normal(90) * np.array([1.0, 2.0, 0.7])[run]
    effect = noise_of_runs(("a", "b", "c"), counts)
    nodes, log_weights = effect.weighed_nodes(residuals, FittedReadings(0 * residuals, 1.0, run))

    def log_z(values):
        law = replace(white_noise(90), sd=values[run])
        whitened = law(residuals)[:, None]
        return (
            -law.minus_log_likelihood(whitened, law.likeliest_sigma(whitened))[0]
            - law.half_log_det()
            + 0.5 * math.log(math.pi / 90)
        )

    laplace = logsumexp([log_z(values) + weight for values, weight in zip(nodes, log_weights, strict=True)])
    squares, brute = np.bincount(run, residuals**2), []
    for spread in (0.1, 0.2, 0.4, 0.8, 1.6):
        logs = spread * rng.standard_normal((40_000, 3))
        left = (squares * np.exp(-2 * logs)).sum(axis=1)
        each = math.log(0.5) + gammaln(45) + 45 * np.log(2 / left) - logs @ np.array(counts, dtype=float)
        brute.append(logsumexp(each) - math.log(40_000))
    assert laplace == pytest.approx(logsumexp(brute) - math.log(5), abs=0.1)


SIMULATOR = Simulator(
    "y", "V", {"a": (-5, 5), "b": (-5, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"], run="run", vectorized=True
)
N_OF_NOISE_MODELS = 40
RUN = np.random.default_rng(1).permutation(np.repeat([0.0, 1.0, 2.0, 3.0], 10))
SORTED = np.argsort([list(dict.fromkeys(RUN.tolist())).index(run) for run in RUN.tolist()], kind="stable")


def _ar1(run, rho, rng):
    noise, last = rng.standard_normal(len(run)), {}
    for k, name in enumerate(run.tolist()):
        if name in last:
            noise[k] = rho * noise[last[name]] + math.sqrt(1 - rho**2) * noise[k]
        last[name] = k
    return noise


def _recording(rows=None):
    rng = np.random.default_rng(2)
    y = 10.0 + _ar1(RUN, 0.5, rng)
    y[[5, 17]] = np.nan
    table = RunTable({"run": RUN, "x": rng.normal(size=N_OF_NOISE_MODELS), "y": y}, run="run")
    return as_recording(SIMULATOR, table if rows is None else table.take(rows))


def test_the_rows_back_to_the_previous_reading_are_those_of_the_run():
    recording, together = _recording(), _recording(SORTED)
    order = order_by_scan(recording)
    np.testing.assert_array_equal(
        n_rows_since_previous_usable(recording)[order], n_rows_since_previous_usable(together)
    )
    before, scan = previous_usable(recording), recording.plan.scan[recording.usable]
    for k in range(len(before)):
        same = np.flatnonzero(scan[:k] == scan[k])
        assert before[k] == (same[-1] if same.size else -1)


N_WITH_LOST = 60
TIME = np.arange(float(N_WITH_LOST))
LOST = np.arange(N_WITH_LOST) % 4 == 1
LAW = NoiseLaw(np.ones(N_WITH_LOST), np.zeros(N_WITH_LOST), LOST)
WITHOUT = white_noise(int((~LOST).sum()))


def test_lost_readings_change_no_density_of_held_out_readings():
    """A line predicts more than a constant, and as much more where lost readings are missing in the table instead."""
    x = np.sin(0.7 * TIME)
    y = 1.0 + 0.1 * x + 0.1 * np.random.default_rng(5).standard_normal(N_WITH_LOST)
    simulators = (
        Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"] + 0 * u["x"]),
        Simulator("y", "V", {"a": (-5, 5), "b": (-5, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"]),
    )
    gains = []
    for readings, law in ((np.where(LOST, -20.0, y), LAW), (np.where(LOST, np.nan, y), WITHOUT)):
        fits = []
        for simulator in simulators:
            prepared = prepare_system(simulator, table_for(simulator, {"x": x, "y": readings}), with_effects=False)
            model = Model(prepared.null, (), prepared.recording.plan)
            fits.append(fit(model, prepared.recording, np.zeros(model.n_params), law))
        parts = (TIME[prepared.recording.usable] // 20).astype(int), ("1", "2", "3")
        gain = held_out_gain(*fits, prepared.recording, law, parts, law_of_null=law)
        gains.append(gain.per_reading * gain.n_readings)
    assert gains[1] > 1
    assert gains[0] == pytest.approx(gains[1], rel=1e-3)


N_OF_OUTLYING = 120
PLACE = Covariate("place", np.linspace(-50, 50, N_OF_OUTLYING), np.arange(N_OF_OUTLYING))


def tailed(n: int = N_OF_OUTLYING) -> NoiseLaw:
    return NoiseLaw(np.ones(n), np.zeros(n), np.zeros(n, dtype=bool), share=0.05, times=6.0)


def test_the_evidence_is_that_of_two_beta_binomials_against_one():
    """Of given numbers in and out of a window, the order within each being even."""
    far_out = np.zeros(N_OF_OUTLYING)
    far_out[[3, 5, 8, 70]] = 1.0
    columns, _ = window_columns(PLACE, N_OF_OUTLYING)
    one = betabinom(N_OF_OUTLYING, 0.5, 0.5).logpmf(4) - np.log(_choose(N_OF_OUTLYING, 4))
    expected = []
    for column in columns.T:
        n, k = int(column.sum()), int(far_out @ column)
        inside = betabinom(n, 0.5, 0.5).logpmf(k) - np.log(_choose(n, k))
        rest = betabinom(N_OF_OUTLYING - n, 0.5, 0.5).logpmf(4 - k) - np.log(_choose(N_OF_OUTLYING - n, 4 - k))
        expected.append(inside + rest - one)
    found = clustering_log_bayes_factors(far_out, [PLACE])
    assert found == {"place, far out": pytest.approx(float(np.log(np.mean(np.exp(expected)))))}


def _choose(n: int, k: int) -> float:
    return float(np.prod([(n - i) / (k - i) for i in range(k)])) if k else 1.0


def test_what_is_in_the_tail_follows_bayes_rule():
    law = tailed()
    residuals = np.random.default_rng(2).standard_normal(N_OF_OUTLYING)
    residuals[10] = 9.0
    sigma = float(law.likeliest_sigma(law(residuals)[:, None])[0])
    odds = (0.05 / 6) * np.exp(-0.5 * (residuals / sigma / 6) ** 2) / (0.95 * np.exp(-0.5 * (residuals / sigma) ** 2))
    np.testing.assert_allclose(outlier_probabilities(residuals, law), odds / (1 + odds))
    assert outlier_probabilities(residuals, law)[10] > 0.999
    residuals[10] = 1e6  # where both densities are nothing
    assert outlier_probabilities(residuals, law)[10] == 1.0


def spotted(rows: np.ndarray) -> Recording:
    """A clean recording with a dozen readings far out."""
    plan = paper_plan()
    world = World(gaussian_spot([Blob(1.0, (0.4, -0.3), (5.0, 3.5), 0.3)], pixel_mm=0.5))
    rng = np.random.default_rng(11)
    readings = world.expected_readings(plan) + 0.4 * rng.standard_normal(len(plan))
    readings[rows] += 5.0 * rng.choice([-1.0, 1.0], len(rows))
    return Recording(plan, readings)


@pytest.mark.slow
def test_outliers_anywhere_are_noise_and_at_one_end_of_a_scan_they_are_not():
    anywhere = diagnose(spotted(np.random.default_rng(4).choice(404, 12, replace=False)), rng=np.random.default_rng(0))
    assert anywhere.verdict == "noise"
    at_one_end = np.concatenate([np.arange(k, k + 12, 4) for k in (86, 187, 288, 389)])
    found = diagnose(spotted(at_one_end), rng=np.random.default_rng(0))
    assert found.verdict == "unknown"
    assert "Outlying readings cluster in place" in found.reason
    assert found.where
