"""Adaptive importance sampling, against a long chain."""

from __future__ import annotations

import numpy as np
import pytest
from refitted import refitted_with
from scipy.special import ndtr

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.samples import sample_model
from probewise.systems import RunTable, Simulator

_N, _SD = 80, 0.1


def _settled(seed):
    """Fit two runs that decay to a level, and settle besides, well detected, as a cooling cup of the challenge."""
    rng = np.random.default_rng(seed)
    time = np.tile(np.linspace(0.0, 60.0, _N // 2), 2)
    run = np.repeat([1.0, 2.0], _N // 2)
    y = 5 * np.exp(-time / 30) - 1.0 * np.exp(-time / 6) + _SD * rng.standard_normal(_N)
    simulator = Simulator(
        "y", "V", {"hot": (0, 20), "tau": ("log", 5, 200)}, simulate=lambda p, u: p["hot"] * np.exp(-u["t"] / p["tau"]),
        time="t", run="run",
    )  # fmt: skip
    prepared = prepare_system(simulator, RunTable({"t": time, "run": run, "y": y}, time="t", run="run"))
    candidate = refitted_with(prepared, "settling")
    return prepared.recording, candidate, candidate.evidence[()]


def _by_chain(recording, found, seed):
    """Draw the last coordinate by a long chain of stretch moves (Goodman and Weare 2010): no approximation."""
    rng, half = np.random.default_rng(seed), 20
    covariance = np.linalg.inv(found.slopes.T @ found.slopes / found.sd**2 + np.eye(len(found.z)))
    z = found.z + rng.standard_normal((2 * half, len(found.z))) @ np.linalg.cholesky(covariance).T

    def height(z):
        rest = recording.readings - found.model.predict(z)
        inside = (np.abs(z) < 6).all(axis=1)
        return np.where(inside, -0.5 * _N * np.log(np.sum(rest**2, axis=1)) - 0.5 * np.sum(z**2, axis=1), -np.inf)

    now, kept = height(z), []
    for k in range(4_000):
        for own, other in ((slice(0, half), slice(half, None)), (slice(half, None), slice(0, half))):
            stretch = (1 + rng.random(half)) ** 2 / 2
            partner = rng.permutation(z[other])
            tried = partner + stretch[:, None] * (z[own] - partner)
            then = height(tried)
            taken = np.log(rng.random(half)) < (z.shape[1] - 1) * np.log(stretch) + then - now[own]
            z[own] = np.where(taken[:, None], tried, z[own])
            now[own] = np.where(taken, then, now[own])
        if k >= 1_000 and k % 10 == 0:
            kept.append(z[:, -1].copy())
    return np.concatenate(kept)


@pytest.mark.slow
def test_intervals_of_a_time_constant_hold_what_they_say_of_the_exact_posterior():
    """Of 500 draws worth some 150, the share within their 95 % interval has an sd of .018; of three recordings, .01."""
    shares = []
    for seed in (1, 2, 3):
        recording, candidate, evidence = _settled(seed)
        found = candidate.found
        samples = sample_model(
            found, evidence, recording, weights=candidate.weights, rng=np.random.default_rng(seed), annealed=True
        )
        low, high = np.quantile(samples.effect_samples("settling")[:, 1], [0.025, 0.975])
        chain = found.model.effects[-1].prior.marginals["tau_s"].from_unit(ndtr(_by_chain(recording, found, seed)))
        shares.append(np.mean((chain > low) & (chain < high)))
    assert np.mean(shares) == pytest.approx(0.95, abs=0.04), shares
