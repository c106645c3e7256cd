"""Draws of an effect on the readings that is linear in all but one parameter, against quadrature."""

import math

import numpy as np
import pytest
from refitted import refitted_with

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.samples import sample_model
from probewise.systems import RunTable, Simulator

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
