"""Readings that come late: held between the rows, or on straight lines."""

import numpy as np
import pytest

from probewise.systems import RunTable
from probewise.systems.forms.readings import delayed_values, lagged_readings

_RNG = np.random.default_rng(1)
_T = np.sort(_RNG.uniform(0, 10, 60))
_X = np.sin(_T) + 0.1 * _T


def _rows(t=_T):
    return RunTable({"t": t, "y": t}, time="t", run=None)


def test_a_reading_that_is_held_between_rows_lags_by_the_share_of_each_gap():
    tau, expected = 0.4, [_X[0]]
    for gap, value in zip(np.diff(_T), _X[1:], strict=True):
        expected.append(expected[-1] + (1 - np.exp(-gap / tau)) * (value - expected[-1]))
    np.testing.assert_allclose(lagged_readings(_X[None], np.array([[tau]]), _rows())[0], expected)


@pytest.mark.parametrize("tau", [0.05, 0.7])
def test_a_late_reading_lies_on_the_lines_between_the_rows(tau):
    late = delayed_values(_X[None], np.array([[tau]]), _rows())
    np.testing.assert_allclose(late[0], np.interp(np.maximum(_T - tau, _T[0]), _T, _X), atol=1e-12)


def test_no_lag_and_no_delay_change_nothing_also_where_rows_share_a_time():
    table = _rows(np.repeat(np.arange(5.0), 2))
    x = _RNG.normal(size=(1, 10))
    for act in (lagged_readings, delayed_values):
        np.testing.assert_array_equal(act(x, np.array([[0.0]]), table), x)
        assert np.isfinite(act(x, np.array([[0.3]]), table)).all()
        assert act(x[:, :1], np.array([[0.3]]), _rows(np.zeros(1))) == x[0, 0]
