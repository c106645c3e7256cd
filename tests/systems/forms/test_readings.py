"""Readings that come late, between rows that are not dense: against integration and the exact reading."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.templates import EffectTemplates
from probewise.systems import Law, RunTable, Simulator
from probewise.systems.forms.readings import delayed_readings, lagged_readings

_RNG = np.random.default_rng(1)
_T = np.sort(_RNG.uniform(0, 10, 60))


def _reading(t):
    return np.sin(t) + 0.1 * t


def _rows(t=_T):
    return RunTable({"t": t, "y": _reading(t)}, time="t", run=None)


@pytest.mark.parametrize("tau", [0.01, 0.3, 2.0, 50.0])
def test_a_smooth_reading_lags_as_its_differential_equation_says(tau):
    exact = solve_ivp(
        lambda t, s: (_reading(t) - s) / tau, (_T[0], _T[-1]), [_reading(_T[0])],
        t_eval=_T, rtol=1e-9, atol=1e-11, method="Radau",
    ).y[0]  # fmt: skip
    smooth, held = lagged_readings(_reading(_T)[None], np.array([[tau, 1.0], [tau, 0.0]]), _rows())
    np.testing.assert_allclose(smooth, exact, atol=2e-3)
    assert np.abs(held - exact).max() > 3 * np.abs(smooth - exact).max()


@pytest.mark.parametrize("tau", [0.05, 0.7])
def test_a_smooth_reading_is_delayed_between_its_rows(tau):
    exact = _reading(np.maximum(_T - tau, _T[0]))
    smooth, straight = delayed_readings(_reading(_T)[None], np.array([[tau, 1.0], [tau, 0.0]]), _rows())
    np.testing.assert_allclose(smooth, exact, atol=3e-3)
    np.testing.assert_allclose(straight, np.interp(np.maximum(_T - tau, _T[0]), _T, _reading(_T)), atol=1e-12)


@pytest.mark.parametrize(("between", "holds"), [(0.0, slice(1, None)), (2.0, slice(None, -1))])
def test_a_reading_that_holds_before_or_after_its_row_lags_by_the_share_of_each_gap(between, holds):
    x, tau, expected = _reading(_T), 0.4, [_reading(_T[0])]
    for gap, value in zip(np.diff(_T), x[holds], strict=True):
        expected.append(expected[-1] + (1 - np.exp(-gap / tau)) * (value - expected[-1]))
    np.testing.assert_allclose(lagged_readings(x[None], np.array([[tau, between]]), _rows())[0], expected)


@pytest.mark.parametrize("between", [0.0, 1.0, 2.0])
def test_no_lag_changes_nothing_also_where_rows_share_a_time(between):
    t = np.repeat(np.arange(5.0), 2)
    table, x = RunTable({"t": t, "y": t}, time="t", run=None), _RNG.normal(size=(1, 10))
    np.testing.assert_array_equal(lagged_readings(x, np.array([[0.0, between]]), table), x)
    assert np.isfinite(lagged_readings(x, np.array([[0.3, between]]), table)).all()


@pytest.mark.parametrize("act", [lagged_readings, delayed_readings])
def test_a_sample_that_diverges_leaves_the_others_as_they_are(act):
    x = np.stack([_reading(_T), np.where(_T > 5, np.inf, _reading(_T))])
    with np.errstate(invalid="ignore"):
        found = act(x, np.full((2, 2), [0.3, 1.0]), _rows())
    np.testing.assert_array_equal(found[0], act(x[:1], np.array([[0.3, 1.0]]), _rows())[0])
    assert not np.isfinite(found[1]).all()


def _cups(every_min, tau_min, delay_min=0.0):
    """Two cups that are stirred in a bath that swings, read every so many minutes by a thermometer."""
    t = np.arange(0.0, 60.0, every_min)
    rng, rows = np.random.default_rng(4), []
    for start in (70.0, 30.0):

        def rates(at, s):
            bath = 40 + 10 * np.sin(2 * np.pi * at / 17)
            return [(bath - s[0]) / 8.0, (s[0] - s[1]) / max(tau_min, 1e-3)]

        dense = solve_ivp(rates, (0, 60), [start, start], dense_output=True, rtol=1e-8, atol=1e-8, method="Radau").sol
        seen = dense(np.maximum(t - delay_min, 0.0))[1 if tau_min else 0]
        rows.append(seen + 0.1 * rng.normal(size=len(t)))
    bath = np.tile(40 + 10 * np.sin(2 * np.pi * t / 17), 2)
    columns = {"t_min": np.tile(t, 2), "cup": np.repeat([1.0, 2.0], len(t)), "bath": bath, "y": np.concatenate(rows)}
    law = Law({"c": "start"}, lambda s, p, u: {"c": (u["bath"] - s["c"]) / p["tau"]}, hold="linear")
    simulator = Simulator(
        "y", "degC", {"start": ("normal", 50, 30), "tau": ("log", 1, 100)}, per_run=["start"], law=law,
        time="t_min", run="cup",
    )  # fmt: skip
    return simulator, RunTable(columns, time="t_min", run="cup")


@pytest.mark.slow
def test_a_lag_and_a_delay_have_a_smooth_variant_where_rows_are_not_dense_beside_the_noise():
    sparse = prepare_system(*_cups(0.8, 0.6)).effects
    assert all(len(sparse[name].variants()) == 2 for name in ("lag", "delay"))
    assert all("smooth" in sparse[name].fixed for name in ("lag", "delay"))
    dense = prepare_system(*_cups(0.06, 0.6)).effects
    assert len(dense["delay"].variants()) == 1


def test_the_variants_have_a_twentieth_and_a_half_of_the_prior_of_the_first():
    """So that a lag and a delay are no less probable where rows are held than what explains the same readings."""
    variants = prepare_system(*_cups(0.8, 0.6)).effects["lag"].variants()
    templates = EffectTemplates((), (), variants, np.array([0, 0, 1, 2]))
    found = templates.variant_probabilities(np.log([3.0, 1.0, 4.0, 2.0]))
    np.testing.assert_allclose(found, np.array([20, 1, 5]) / 26)
