"""Noise of runs, one after the other and interleaved."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import gammaln, logsumexp

from probewise.diagnosis.noise import n_rows_since_previous_usable, order_by_scan, previous_usable, white_noise
from probewise.effects.noise import noise_of_runs
from probewise.effects.noise_distribution import FittedReadings
from probewise.systems import RunTable, Simulator, as_recording


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
N = 40
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
    table = RunTable({"run": RUN, "x": rng.normal(size=N), "y": y}, run="run")
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
