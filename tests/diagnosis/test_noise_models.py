"""Noise of runs, one after the other and interleaved."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import gammaln, logsumexp

from probewise.diagnosis.noise import (
    white_noise,
)
from probewise.effects.noise import noise_of_runs
from probewise.effects.noise_distribution import FittedReadings


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
