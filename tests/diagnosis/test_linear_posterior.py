"""Posteriors in closed form, against quadrature and sampling."""

import math
from dataclasses import replace

import numpy as np
import pytest
from refitted import refitted_with

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import laplace_evidence
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.noise import NoiseModel, white_noise
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
    samples = sample_model(found, evidence, prepared.recording, weights=weights, rng=rng, laplace_only=True)
    return found, samples.effect_samples("gain_per_run"), y


@pytest.mark.parametrize("laplace_only", [False, True])
def test_values_of_one_size_leave_open_what_they_have_in_common(laplace_only):
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
        found, evidence, prepared.recording, weights={"offset_per_run": np.ones(1)}, rng=rng, laplace_only=laplace_only
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
    four_errors = 4 / np.sqrt(250)  # sds, of the least effective number of draws
    np.testing.assert_allclose(samples.mean(axis=0), mean, atol=four_errors * np.sqrt(spread[0, 0]))
    common = np.sqrt(spread.mean())
    assert common > 4 * SD / np.sqrt(N)  # far more than the readings would leave open without the values
    assert samples.mean(axis=1).std() == pytest.approx(common, rel=0.2)


_N, _SD = 80, 0.02
_TIME = np.tile(np.linspace(0.0, 120.0, _N // 2), 2)
_RUN = np.repeat([1.0, 2.0], _N // 2)


def _by_rows(p, u):
    return [p["level"] * math.exp(-t / 30) for t in u["t"]]


def _by_columns(p, u):
    return p["level"] * np.exp(-u["t"] / 30)


@pytest.fixture(scope="module", params=[_by_rows, _by_columns])
def fitted(request):
    """A tank that empties within 30 s, and a settling about as fast: its size and time constant lie on a hyperbola."""
    y = 10 * np.exp(-_TIME / 30) + 1.5 * np.exp(-_TIME / 25) + _SD * np.random.default_rng(5).standard_normal(_N)
    simulator = Simulator("y", "cm", {"level": (0, 20)}, simulate=request.param, time="t", run="run")
    prepared = prepare_system(simulator, RunTable({"t": _TIME, "run": _RUN, "y": y}, time="t", run="run"))
    return prepared, refitted_with(prepared, "settling")


def _probabilities_by_quadrature(readings, effect):
    """The level has a uniform prior, and is integrated out in closed form; a sum over sizes and time constants."""
    of_a, of_tau = (effect.prior.marginals[name] for name in ("a", "tau_s"))
    a = np.sort(np.concatenate([sign * np.geomspace(1e-3, 40, 4000) for sign in (-1, 1)]))
    u = (np.arange(1500) + 0.5) / 1500
    tau = of_tau.from_unit(u)
    tank = np.exp(-_TIME / 30)
    tank /= np.linalg.norm(tank)
    pulse = np.exp(-_TIME / tau[:, None])
    pulse -= np.outer(pulse @ tank, tank)
    rest = readings - (readings @ tank) * tank
    squares = rest @ rest - 2 * a * (pulse @ rest)[:, None] + a**2 * np.sum(pulse**2, axis=1)[:, None]
    height = -0.5 * (_N - 1) * np.log(squares) + of_a.log_prob(a) + np.log(np.gradient(a))
    shares = np.exp(height - height.max())
    return a, tau, shares / shares.sum()


def test_size_and_time_constant_of_a_settling_are_as_probable_as_by_quadrature(fitted):
    """Of 500 draws worth 400 a share has an sd of .025; that one of seven is off by four has a chance of 4e-4."""
    prepared, candidate = fitted
    a, tau, exact = _probabilities_by_quadrature(prepared.recording.readings, candidate.found.model.effects[-1])
    found = sample_model(
        candidate.found, candidate.evidence[()], prepared.recording, weights=candidate.weights,
        rng=np.random.default_rng(2),
    ).effect_samples("settling").T  # fmt: skip
    positive = exact[:, a > 0].sum()
    assert 0.1 < positive < 0.9
    for values, of_values, drawn in ((a, exact.sum(axis=0), found[0]), (tau, exact.sum(axis=1), found[1])):
        for share in (0.1, 0.5, 0.9):
            quantile = values[np.searchsorted(np.cumsum(of_values), share)]
            assert np.mean(drawn <= quantile) == pytest.approx(share, abs=0.1)
    assert np.mean(found[0] > 0) == pytest.approx(positive, abs=0.1)
