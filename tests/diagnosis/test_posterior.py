"""Priors and posteriors: prior odds, folded priors, draws, closed forms against quadrature and sampling."""

import dataclasses
import itertools
import math
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from refitted import refitted_with

from probewise.diagnosis import PriorOdds
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import laplace_evidence
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.noise import NoiseLaw, NoiseModel, white_noise
from probewise.diagnosis.posterior import (
    FoldedNormal,
    StandardNormal,
    draw_by_annealing,
    log_likelihood_marginal_over_sigma,
    quadratic_predictions,
    surrogate_log_density,
)
from probewise.diagnosis.samples import sample_model
from probewise.diagnosis.sensors import default_sensor
from probewise.diagnosis.simulator_rows import SimulatorApparatus
from probewise.effects import RARE_EFFECTS, VOCABULARY, Extent
from probewise.recordings import Recording, paper_plan, two_way_plan
from probewise.sensor import Stage
from probewise.systems import RunTable, Simulator


def normal(center, factor, n, rng):
    """Draw n times about a centre, the factor a square root of the covariance; and the density of that."""
    inverse = np.linalg.inv(factor)
    first = center + rng.standard_normal((n, len(center))) @ factor
    return first, lambda z: -0.5 * np.sum(((z - center) @ inverse) ** 2, axis=1)


def drawn(center, factor, log_p, seed, n_walkers=400, n_wanted=800):
    rng = np.random.default_rng(seed)
    first, log_q = normal(np.array(center), np.array(factor), n_walkers, rng)
    return draw_by_annealing(first, log_q, log_p, n_moves=6, n_wanted=n_wanted, rng=rng)


def test_a_bent_density_keeps_its_moments():
    """Route two: quadrature. x is normal, y is normal about x^2 / 2."""

    def log_p(z):
        return -0.5 * z[:, 0] ** 2 - 2 * (z[:, 1] - z[:, 0] ** 2 / 2) ** 2

    x, y = np.meshgrid(np.linspace(-6, 6, 601), np.linspace(-4, 20, 1201), indexing="ij")
    weight = np.exp(log_p(np.stack([x.ravel(), y.ravel()], axis=1)))
    truth = np.average(y.ravel(), weights=weight), np.average(x.ravel() ** 2, weights=weight)
    assert truth == pytest.approx((0.5, 1.0), abs=1e-3)
    runs = [drawn([0.0, 0.0], np.diag([1.0, 0.5]), log_p, seed) for seed in range(20)]
    for found, value in (([z[:, 1].mean() for z in runs], truth[0]), ([np.mean(z[:, 0] ** 2) for z in runs], truth[1])):
        assert abs(np.mean(found) - value) < 4 * np.std(found, ddof=1) / np.sqrt(20) + 0.02


CENTER = np.array([0.3, -0.2, 1.0])
STEPS = np.array([[0.4, 0.1, 0.0], [0.0, 0.3, -0.2], [0.0, 0.0, 0.5]])
PLACES = np.linspace(0.0, 3.0, 40)


def curve(z):
    """A bell of free height, place and width: no polynomial of its parameters."""
    return z[:, :1] * np.exp(-0.5 * ((PLACES - 1 - z[:, 1:2]) / z[:, 2:3]) ** 2)


def predicted(quadratic, e):
    center, coefficients, changes = quadratic
    return center + coefficients(e) @ changes


CARRY = np.where(np.arange(40) % 20 > 0, 0.4, 0.0)
LOST = np.arange(40) == 7
LAW = NoiseLaw(np.linspace(0.8, 1.2, 40), np.where(LOST | np.roll(LOST, 1), 0.0, CARRY), LOST)


def noisy(sd, seed=5, law=LAW):
    """Readings at the centre, with noise that the law makes independent."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal(40) * np.where(rng.random(40) < law.share, law.times, 1.0)
    own = np.zeros(40)
    for k in range(40):
        own[k] = law.carry[k] * own[k - 1] + np.sqrt(1 - law.carry[k] ** 2) * white[k]
    return curve(CENTER[None, :])[0] + sd * law.sd * own


def about_the_center(e):
    return curve(CENTER + e @ STEPS)


def test_the_density_is_that_of_its_predictions():
    """Route two: readings predicted one by one and whitened; it looks at a few sums alone."""
    quadratic, readings = quadratic_predictions(about_the_center, 3, 1e-9), noisy(0.05)
    e = np.random.default_rng(5).standard_normal((30, 3))
    z = CENTER + e @ STEPS
    residuals = (readings - predicted(quadratic, e)).T
    expected = log_likelihood_marginal_over_sigma(LAW, LAW(residuals)) - 0.5 * np.sum(z**2, axis=1)
    near = surrogate_log_density(curve, CENTER, STEPS, readings, LAW, 1e-9)
    np.testing.assert_allclose(near(e), expected, rtol=1e-9)
    assert near(np.full((1, 3), 100.0))[0] == -np.inf


def test_under_a_tail_the_density_falls_off_as_it_should():
    """By the mean of the true fall over the noise: one reading's says little, and thousands differ by chance."""
    tailed = dataclasses.replace(LAW, share=0.1, times=5.0)
    e = 0.3 * np.random.default_rng(6).standard_normal((20, 3))
    quadratic = quadratic_predictions(about_the_center, 3, 1e-9)
    falls = []
    for seed in range(60):
        readings = noisy(0.1, seed, tailed)
        near = surrogate_log_density(curve, CENTER, STEPS, readings, tailed, 1e-9)
        true = [
            log_likelihood_marginal_over_sigma(tailed, tailed((readings - predicted(quadratic, at)).T))
            for at in (e, np.zeros((1, 3)))
        ]
        prior = 0.5 * np.sum((CENTER + e @ STEPS) ** 2, axis=1) - 0.5 * np.sum(CENTER**2)
        falls.append([true[1] - true[0], near(np.zeros((1, 3))) - near(e) - prior])
    true, found = np.mean(falls, axis=0)
    np.testing.assert_allclose(found, true, rtol=0.25, atol=0.3)
    assert true.max() > 5


N, SD = 60, 0.1
RUN = np.repeat(np.arange(6.0), N // 6)
DRIVE = np.tile(np.linspace(0.2, 2.0, N // 6), 6)


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


PLAN = paper_plan().take(np.arange(0, 408, 8))
EXTENT = Extent.of(Recording(PLAN, np.linspace(10.0, 60.0, len(PLAN))))


def prior_of(n_gaussians: int) -> FoldedNormal:
    sensor = default_sensor(EXTENT, n_gaussians)
    near = 0.8 * np.random.default_rng(1).standard_normal(sensor.n_params + 2)  # two of an effect behind
    return FoldedNormal(sensor.n_params + 2, sensor, near)


@pytest.mark.parametrize("n_gaussians", [2, 3])
def test_all_orders_fold_to_one_where_the_density_is(n_gaussians):
    prior = prior_of(n_gaussians)
    n_own = prior.sensor.n_params
    z = np.random.default_rng(3).standard_normal((200, n_own + 2))
    once = prior.fold(z)
    assert np.isfinite(prior.log_prob(once)).all()
    np.testing.assert_array_equal(once[:, n_own:], z[:, n_own:])
    for order in itertools.permutations(range(n_gaussians)):
        other = np.concatenate([prior.sensor.permuted(z[:, :n_own], order), z[:, n_own:]], axis=1)
        np.testing.assert_allclose(prior.fold(other), once, atol=1e-9)


def test_the_folded_density_sums_to_one():
    """Twice the plain one on half of it: a share of 40,000 draws, beyond 4.4 standard errors once in 100,000 times."""
    prior = prior_of(2)
    z = np.random.default_rng(4).standard_normal((40_000, prior.n_params))
    ratio = np.exp(prior.log_prob(z) - StandardNormal(prior.n_params).log_prob(z))
    assert set(np.round(np.unique(ratio), 9)) == {0.0, 2.0}
    assert abs(ratio.mean() - 1.0) < 4.4 * 1.0 / 200


@pytest.mark.slow
def test_where_orders_differ_in_density_what_is_drawn_has_the_folded_one():
    """Three Gaussians: shares of folded draws in two halves of the domain, against the folded density by importance."""
    prior = prior_of(3)
    rng = np.random.default_rng(5)
    drawn = prior.from_unit_cube(rng.random((40_000, prior.n_params)))
    z = rng.standard_normal((40_000, prior.n_params))
    ratio = np.exp(prior.log_prob(z) - StandardNormal(prior.n_params).log_prob(z))
    for column in (0, 1, 4):
        middle = np.median(drawn[:, column])
        upper = ratio * (z[:, column] > middle)
        assert abs(upper.mean() - 0.5) < 4.4 * np.hypot(upper.std(), 0.5) / 200


OF_NO_LAW = SimpleNamespace(about=SimpleNamespace(states_with_rates_by_definition=frozenset()))
EXTENT_OF_PRIOR_ODDS = Extent(10.0, 60.0, two_way_plan())
EFFECTS = {**VOCABULARY, **RARE_EFFECTS}


def test_everything_about_the_mean_sums_to_one_but_for_what_is_unknown_beside():
    effects = {name: kind.for_extent(EXTENT_OF_PRIOR_ODDS) for name, kind in EFFECTS.items()}
    odds = PriorOdds.for_effects({name: effect for name, effect in effects.items() if effect is not None})
    named = [n for n, kind in VOCABULARY.items() if kind.stage is not Stage.NOISE and effects[n] is not None]
    total = math.exp(odds.log_prior_with_unknown(()))
    total += sum(math.exp(odds.log_prior_on_mean(names)) for k in range(4) for names in combinations(named, k))
    total += sum(math.exp(odds.log_prior_on_mean((name,))) for name in RARE_EFFECTS)
    assert total == pytest.approx(1.0, abs=1e-9)


def test_every_noise_sums_to_one():
    odds = replace(SimulatorApparatus.prior_odds(cast(Any, OF_NO_LAW), {}), n_noises=5)
    sets = (names for k in range(4) for names in combinations("abcde", k))
    assert sum(math.exp(odds.log_prior_on_noise(names)) for names in sets) == pytest.approx(1.0)
